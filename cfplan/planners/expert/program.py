"""The nonlinear program of a speed profile: sparse structure and derivatives, built once a shape.

Variables are (state, control) of each interval, then the last state. Every cost and constraint belongs to one interval,
because the state at its right end follows from its own variables. Derivatives are put together from the point
functions' blocks, so nothing is differentiated here and nothing is compiled. Only IPOPT, the second try, needs it all;
the layout serves both solvers.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import casadi
import numpy as np
from numpy.typing import NDArray

from cfplan.planners.expert import point_constraints

DYNAMICS_GIVEN = np.array([[1, 1, 1 / 2, 1 / 6], [0, 1, 1, 1 / 2], [0, 0, 1, 1]])
# x, x', x'' at the right end from (x, x', x'', x''') at the left, in node units
DYNAMICS_FREE = np.zeros((5, 7))
DYNAMICS_FREE[:3, [0, 1, 2, 5]] = DYNAMICS_GIVEN
DYNAMICS_FREE[3, [3, 4, 6]] = 1, 1, 1 / 2
DYNAMICS_FREE[4, [4, 6]] = 1, 1

OBJECTIVE_SCALE = 1000.0
# of the cost in seconds, so that multipliers are about 1


@dataclass(frozen=True, slots=True)
class Shape:
    """What a program's structure depends on."""

    nodes: int
    free_yaw: bool
    turning_limited: bool = False
    # whether angular acceleration has a limit of its own
    end_intervals: tuple[int, int] = (3, 3)
    # intervals at each end with more points inside
    end_places: tuple[float, ...] = (0.2, 0.5, 0.8)
    middle_places: tuple[float, ...] = (0.5,)
    # points inside every other interval
    speed_places: tuple[float, ...] = (0.5,)
    # where the speed limit holds besides the nodes


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the points lie and where their rows go."""

    shape: Shape
    interval: NDArray = field(init=False)
    # (P,) of each point
    place: NDArray = field(init=False)
    # (P,) in its interval, 0 to 1
    s: NDArray = field(init=False)
    # (P,) the same from the first node on, in intervals
    weight: NDArray = field(init=False)
    # (P,) of the penalties: 1 at the left end of an interval, else 0
    selected: NDArray = field(init=False)
    # (G,) entry of the (ROWS, P) rows, column by column, that each nonlinear constraint takes
    row: NDArray = field(init=False)
    # (G,) which of the rows that is
    point: NDArray = field(init=False)
    # (G,) and at which point
    dynamics_rows: NDArray = field(init=False)
    # (N, nx) in the constraint vector
    point_rows: NDArray = field(init=False)
    # (G,) in the constraint vector
    speed_rows: NDArray = field(init=False)
    # (N, speed places) in the constraint vector
    speed_s: NDArray = field(init=False)
    # (N + 1 + N speed places,) where the speed limit holds, in intervals: at the nodes, and then between
    counts: tuple[int, ...] = field(init=False)
    # (N+1,) constraints of each stage that are not dynamics

    def __post_init__(self) -> None:
        shape = self.shape
        interval: list[int] = []
        place, weight, selected = [], [], []
        dynamics_rows, point_rows, speed_rows, counts = [], [], [], []
        row = 0
        states = self.states
        every = [
            r
            for r in range(point_constraints.ROWS)
            if shape.turning_limited or r != point_constraints.ANGULAR_ACCELERATION
        ]
        jumping = [r for r in every if r in point_constraints.JUMPING]
        for k in range(shape.nodes):
            at_end = k < shape.end_intervals[0] or k >= shape.nodes - shape.end_intervals[1]
            inside = shape.end_places if at_end else shape.middle_places
            last = k == shape.nodes - 1
            points = [(0.0, every), *((p, every) for p in inside), (1.0, every if last else jumping)]
            places = np.array([p for p, _ in points])
            weights = (places == 0.0) * 1.0  # penalties count once an interval
            dynamics_rows.append(np.arange(row, row + states))
            row += states
            start = row
            for (p, rows), w in zip(points, weights, strict=True):
                selected += [len(interval) * point_constraints.ROWS + r for r in rows]
                point_rows += list(range(row, row + len(rows)))
                row += len(rows)
                interval.append(k)
                place.append(p)
                weight.append(w)
            speed_rows.append(np.arange(row, row + len(shape.speed_places)))
            row += len(shape.speed_places)
            counts.append(row - start)
        nodes = np.arange(shape.nodes + 1.0)
        between = (nodes[:-1, None] + np.array(shape.speed_places)).ravel()
        for name, value in (
            ("interval", np.array(interval)), ("place", np.array(place)), ("weight", np.array(weight)),
            ("s", np.array(interval) + np.array(place)), ("speed_s", np.concatenate([nodes, between])),
            ("selected", np.array(selected)), ("row", np.array(selected) % point_constraints.ROWS),
            ("point", np.array(selected) // point_constraints.ROWS), ("dynamics_rows", np.array(dynamics_rows)),
            ("point_rows", np.array(point_rows)), ("speed_rows", np.array(speed_rows)), ("counts", (*counts, 0)),
        ):  # fmt: skip
            object.__setattr__(self, name, value)

    @property
    def states(self) -> int:
        return 5 if self.shape.free_yaw else 3

    @property
    def controls(self) -> int:
        return 2 if self.shape.free_yaw else 1

    @property
    def block(self) -> int:
        """Variables of an interval."""
        return self.states + self.controls

    @property
    def variables(self) -> int:
        return self.shape.nodes * self.block + self.states

    @property
    def constraints(self) -> int:
        return self.shape.nodes * self.states + sum(self.counts)

    @property
    def parameters(self) -> int:
        return len(self.interval) * point_constraints.POINT_DATA + point_constraints.COMMON_DATA + 3

    def speed_weights(self) -> NDArray:
        """(speed places, block): x at each place from an interval's variables."""
        jerk = 5 if self.shape.free_yaw else 3
        weights = np.zeros((len(self.shape.speed_places), self.block))
        for row, p in enumerate(self.shape.speed_places):
            weights[row, [0, 1, 2, jerk]] = 1, p, p * p / 2, p**3 / 6
        return weights


@lru_cache(maxsize=32)
def layout_of(shape: Shape) -> Layout:
    """The layout of a shape, made once a process."""
    return Layout(shape)


class Program:
    """f, g and their derivatives as CasADi functions over all points at once."""

    def __init__(self, shape: Shape) -> None:
        self.layout = layout = layout_of(shape)
        n, block, count = shape.nodes, layout.block, len(layout.interval)
        self._functions = point_constraints.point_functions(shape.free_yaw)
        self._name = point_constraints.family(shape.free_yaw)

        x = casadi.MX.sym("x", layout.variables)
        p = casadi.MX.sym("p", layout.parameters)
        factor = casadi.MX.sym("lam_f")
        multipliers = casadi.MX.sym("lam_g", layout.constraints)

        z = casadi.reshape(x[: n * block], block, n)
        point_z = z[:, [int(k) for k in layout.interval]]
        data = casadi.reshape(p[: count * point_constraints.POINT_DATA], point_constraints.POINT_DATA, count)
        common = p[
            count * point_constraints.POINT_DATA : count * point_constraints.POINT_DATA + point_constraints.COMMON_DATA
        ]
        weights = OBJECTIVE_SCALE * p[-3:]
        inputs = [point_z, data, casadi.repmat(common, 1, count), casadi.repmat(weights, 1, count)]
        second = OBJECTIVE_SCALE / casadi.sqrt(common[14])  # of time in node units

        left = [int(i) for i in np.flatnonzero(layout.weight)]
        left_inputs = [z, data[:, left], casadi.repmat(common, 1, n), casadi.repmat(weights, 1, n)]

        linear = self._linear()
        to_gradient = _scatter(layout.interval[:, None] * block + np.arange(block), layout.variables)
        interval_to_gradient = _scatter(np.arange(n)[:, None] * block + np.arange(block), layout.variables)

        # values
        time = casadi.sum2(self._call("time", n, [z]))
        f = second * time + casadi.sum2(self._call("penalty", n, left_inputs))
        rows = casadi.vec(self._call("rows", count, inputs))
        g = self._constraints(rows, linear, x)

        # first derivatives
        gradient_f = casadi.mtimes(interval_to_gradient, casadi.vec(self._call("penalty_gradient", n, left_inputs)))
        gradient_f += second * casadi.mtimes(interval_to_gradient, casadi.vec(self._call("time_gradient", n, [z])))
        rows_again, blocks = self._call("jacobian", count, inputs)
        jacobian = self._jacobian(blocks, linear)

        # second derivatives
        point_multipliers = casadi.reshape(
            casadi.mtimes(
                _scatter(layout.selected, count * point_constraints.ROWS),
                multipliers[[int(r) for r in layout.point_rows]],
            ),
            point_constraints.ROWS, count,
        )  # fmt: skip
        point_gradient, point_hessian = self._call(
            "hessian", count, [*inputs, point_multipliers, casadi.repmat(factor, 1, count)]
        )
        time_gradient, time_hessian = self._call("time_hessian", n, [z])
        gradient_l = casadi.mtimes(to_gradient, casadi.vec(point_gradient)) + casadi.mtimes(linear.T, multipliers)
        gradient_l += factor * second * casadi.mtimes(interval_to_gradient, casadi.vec(time_gradient))
        hessian = self._hessian(point_hessian, factor * second * time_hessian)

        names = (["x", "p"], ["lam_f", "lam_g"])
        self.nlp = casadi.Function("nlp", [x, p], [f, g], names[0], ["f", "g"])
        self.f = casadi.Function("nlp_f", [x, p], [f], names[0], ["f"])
        self.g = casadi.Function("nlp_g", [x, p], [g], names[0], ["g"])
        gradient = [f, casadi.densify(gradient_f)]  # IPOPT is handed the entries as they lie, as if all were there
        self.gradient = casadi.Function("nlp_grad_f", [x, p], gradient, names[0], ["f", "grad_f_x"])
        self.jacobian = casadi.Function(
            "nlp_jac_g", [x, p], [self._constraints(casadi.vec(rows_again), linear, x), jacobian], names[0],
            ["g", "jac_g_x"],
        )  # fmt: skip
        arguments = [x, p, factor, multipliers]
        self.multipliers = casadi.Function(
            "nlp_grad", arguments, [f, g, gradient_l, casadi.MX(layout.parameters, 1)], names[0] + names[1],
            ["f", "g", "grad_gamma_x", "grad_gamma_p"],
        )  # fmt: skip
        self.upper_hessian = casadi.Function(
            "nlp_hess_l", arguments, [casadi.triu(hessian)], names[0] + names[1], ["triu_hess_gamma_x_x"]
        )

    def _call(self, title: str, count: int, arguments: list[casadi.MX]):
        return self._functions[f"{self._name}_{title}"].map(count)(*arguments)

    def _linear(self) -> casadi.DM:
        """(constraints, variables): the Jacobian of the dynamics and of the speed rows, which is constant."""
        layout = self.layout
        n, block, states = layout.shape.nodes, layout.block, layout.states
        dynamics = DYNAMICS_FREE if layout.shape.free_yaw else DYNAMICS_GIVEN
        columns = np.arange(n)[:, None] * block + np.arange(block)
        entries = [
            (np.repeat(layout.dynamics_rows, block, axis=1), np.tile(columns, states), np.tile(-dynamics.ravel(), n)),
            (layout.dynamics_rows, columns[:, :states] + block, np.ones(n * states)),
        ]
        if weights := len(layout.shape.speed_places):
            values = np.tile(layout.speed_weights().ravel(), n)
            entries.append((np.repeat(layout.speed_rows, block, axis=1), np.tile(columns, weights), values))
        rows = np.concatenate([e[0].ravel() for e in entries])
        cols = np.concatenate([e[1].ravel() for e in entries])
        return casadi.DM.triplet(
            rows.tolist(), cols.tolist(), casadi.DM(np.concatenate([e[2] for e in entries])),
            layout.constraints, layout.variables,
        )  # fmt: skip

    def _constraints(self, rows: casadi.MX, linear: casadi.DM, x: casadi.MX) -> casadi.MX:
        layout = self.layout
        placed = casadi.mtimes(_scatter(layout.point_rows, layout.constraints), rows[[int(i) for i in layout.selected]])
        return placed + casadi.mtimes(linear, x)

    def _jacobian(self, blocks: casadi.MX, linear: casadi.DM) -> casadi.MX:
        layout, block = self.layout, self.layout.block
        point, row = layout.point, layout.row
        entry = (
            point[:, None] * (point_constraints.ROWS * block) + np.arange(block) * point_constraints.ROWS + row[:, None]
        )
        rows = np.repeat(layout.point_rows, block)
        cols = (layout.interval[point][:, None] * block + np.arange(block)).ravel()
        linear_rows, linear_cols = (np.array(i) for i in linear.sparsity().get_triplet())
        values = casadi.vertcat(casadi.vec(blocks), casadi.MX(casadi.DM(linear.nonzeros())))
        entries = np.concatenate([entry.ravel(), blocks.numel() + np.arange(linear.nnz())])
        return _sparse(
            values, entries, np.concatenate([rows, linear_rows]), np.concatenate([cols, linear_cols]),
            layout.constraints, layout.variables,
        )  # fmt: skip

    def _hessian(self, points: casadi.MX, times: casadi.MX) -> casadi.MX:
        layout, block = self.layout, self.layout.block
        within = np.arange(block * block)
        to = np.concatenate([
            (layout.interval[:, None] * block * block + within).ravel(), np.arange(layout.shape.nodes * block * block)
        ])  # fmt: skip
        summed = casadi.mtimes(
            _scatter(to, layout.shape.nodes * block * block), casadi.vertcat(casadi.vec(points), casadi.vec(times))
        )
        cols, rows = np.divmod(within, block)
        offset = np.arange(layout.shape.nodes)[:, None] * block
        return _sparse(
            summed, np.arange(layout.shape.nodes * block * block), (offset + rows).ravel(), (offset + cols).ravel(),
            layout.variables, layout.variables,
        )  # fmt: skip


def _scatter(to: NDArray, size: int) -> casadi.DM:
    """(size, len(to)): adds entry j to place to[j]."""
    flat = to.ravel()
    return casadi.DM(casadi.Sparsity.triplet(size, len(flat), flat.tolist(), list(range(len(flat)))), 1.0)


def _sparse(values: casadi.MX, entries: NDArray, rows: NDArray, cols: NDArray, m: int, n: int) -> casadi.MX:
    """An (m, n) matrix whose (rows[j], cols[j]) is values[entries[j]]."""
    order = np.lexsort((rows, cols))
    sparsity = casadi.Sparsity.triplet(m, n, rows[order].tolist(), cols[order].tolist())
    return casadi.MX(sparsity, values[[int(e) for e in entries[order]]])


@lru_cache(maxsize=32)
def program(shape: Shape) -> Program:
    """The program of a shape, made once a process."""
    return Program(shape)
