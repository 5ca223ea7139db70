"""Abort reasons: the text, meaning and cure of every reason for which the pilot ends a flight in the air.

The pilot makes its messages from this table, and docs/errors.md is rendered from it.
"""

from dataclasses import dataclass
from enum import Enum

from cfplan.errors import ExitCode
from cfplan.flight.pilot.outcome import Rung


@dataclass(frozen=True, slots=True)
class Abort:
    """A reason to leave the plan, and how."""

    rung: Rung
    exit_code: ExitCode
    text: str
    cure: str = ""


class AbortReason(Enum):
    """A reason to end a flight: a message with {fields}, its meaning, and its cure (empty where nothing is wrong)."""

    OPERATOR_LAND = (
        "the operator ended the flight",
        "Space, or Ctrl-C once: the vehicle braked and landed.",
        "",
        ExitCode.ENDED_BY_OPERATOR,
    )
    OPERATOR_CUT = (
        "the operator cut the motors",
        "Esc, or Ctrl-C twice: the motors stopped at once.",
        "restart the vehicle before the next flight",
        ExitCode.ENDED_BY_OPERATOR,
    )
    FLEET_BRAKES = (
        "the fleet brakes: {reason}",
        "Vehicles of a fleet brake and land together: another one left its plan, does not answer or came too near, or "
        "the process that conducts them is silent.",
        "look at the vehicle that ended first",
    )
    MAIN_PROCESS_GONE = (
        "the main process is gone",
        "The terminal was closed or the command was killed. The pilot is a separate process and landed the vehicle.",
        "use tmux or screen where the terminal may close",
    )
    LATE_SETPOINT = (
        "a setpoint was {seconds:.2f} s late",
        "This computer stalled, and the vehicle would soon have levelled out by itself. It brakes and lands.",
        "close other programs on this computer, and permit SCHED_FIFO (`cfplan doctor` says how)",
    )
    UPLINK_GONE = (
        "the vehicle has acknowledged nothing for {seconds:g} s",
        "The radio link is down. The vehicle has left its path; it lands where it is once it acknowledges again.",
        "move the antenna nearer, choose a channel of 80 or above, and keep USB cables and Wi-Fi away from it",
    )
    LINK_LOST = (
        "the link was lost: {reason}",
        "The vehicle did not acknowledge again, or the radio was pulled out. Since then it is "
        "[alone](what-breaks.md#the-vehicle-is-alone).",
        "restart the vehicle, then check antenna, channel and USB cable",
        ExitCode.LINK_LOST,
    )
    LOG_GONE = (
        "the vehicle's log of its {log} has been silent for {seconds:g} s",
        "The vehicle receives, but no longer reports its estimate or its status. It brakes along its path and lands by "
        "the poses.",
        "close every other client of this vehicle: a client that connects deletes all logs",
    )
    NO_POSE = (
        "there is no pose",
        "Motion capture has sent no pose since take-off.",
        "check motion capture with `cfplan mocap`",
    )
    POSE_NOT_SENT = (
        "no pose goes to the vehicle: {reason}",
        "Poses arrive, but too late to be used, or the pilot rejects them for the reason given.",
        "check the network between motion capture and this computer, and the tracked body with `cfplan mocap`",
    )
    POSE_OLD = (
        "the last good pose is {seconds:.2f} s old{reason}",
        "Beyond `pose.age_brake` the vehicle brakes, beyond `pose.age_land` it lands. If poses came since, the "
        "brackets say why they were rejected.",
        "check markers and network with `cfplan mocap`; for a virtual vehicle, close other programs on this computer",
    )
    SUPERVISOR_FAULT = (
        "the vehicle {fault}",
        "The vehicle's supervisor reports that it tumbled, is locked or has crashed, or that a deck failed, for which "
        "firmware from 2026.08 on stops the motors itself. The motors stop.",
        "restart the vehicle, and replay the record to see what came before",
    )
    MOTOR_TEST = (
        "a motor test is on",
        "Another client has set `motorPowerSet.enable` since preflight. The motors then turn as it says, disarmed and "
        "locked too. cfplan sets it to 0 again, and the vehicle lands.",
        "end every other client of this vehicle",
    )
    BATTERY_LOW = (
        "the battery is down to {volts:.2f} V",
        "The average under load is below `battery.under_load`, or the hover after take-off shows that it cannot give "
        "the plan's largest motor thrust. The vehicle lands.",
        "charge the battery, or use a fresh one: old ones sag",
    )
    BEYOND_FENCE = (
        "{value:.2f} m beyond the fence",
        "The fence is the space less its margin, without the floor, and without the obstacles and the margin about "
        "them; `flight.fence` says how far beyond it the vehicle brakes, lands and is cut.",
        "replay the record: did the deviation grow, or is `space` in safety.yaml smaller than the room?",
    )
    DEVIATION = (
        "{value:.2f} m from the setpoint",
        "The measured position is farther from the setpoint than `flight.deviation` allows.",
        "fly with a lower --speed; `cfplan identify` measures mass, thrust and lag",
    )
    ESTIMATE_DISAGREES = (
        "pose and estimate are {metres:.2f} m apart",
        "The vehicle's estimate of its position differs from motion capture by five times `pose.agreement`.",
        "look for reflections, a second body with the same markers, or another sender of poses",
    )
    MOTION_LIMIT = (
        "{quantity} of {value:.1f} {unit}",
        "Measured speed, acceleration or angular velocity was beyond its entry of `flight` in safety.yaml for longer "
        "than `flight.patience`.",
        "fly with a lower --speed, or raise that entry of `flight`",
    )
    FALLEN = (
        "it is on the floor without poses, {metres:.2f} m below its setpoint",
        "Without poses, the vehicle's own estimate is below the floor while its setpoint is above: it fell. The motors "
        "stop.",
        "check the propellers, then why motion capture lost it; the record shows which came first",
    )
    DOES_NOT_RISE = (
        "the vehicle does not rise",
        "At the end of the take-off it is below half its height. It lands.",
        "charge the battery, check the propellers, and compare mass and thrust with the airframe",
    )
    OTHER_THRUST = (
        "in hover the thrust scale is {scale:.2f}, and the plan was certified for {least:.2f} to {most:.2f}: set "
        "`mass: {mass:.4f}` in the airframe file if it weighs that, else `thrust_scale: {scale:.2f}`",
        "In the second after take-off the motors' commands and the battery's voltage show how much thrust carries the "
        "weight. The vehicle is heavier or lighter, or its motors are weaker or stronger, than `mass`, `thrust_scale` "
        "and `spread` of the airframe say. It lands before the way to the start.",
        "weigh it with its battery, change that line of the airframe file, and plan again",
    )
    NOT_AT_START = (
        "still {metres:.2f} m from the start",
        "It took off, but does not come to rest where the plan begins. It lands.",
        "replay the record: does the estimate follow the poses? Compare mass and thrust with the airframe",
    )
    MOTORS_DO_NOT_STOP = (
        "the vehicle does not land",
        "It was asked to stop its motors, and still reports that it flies. The motors are cut.",
        "restart the vehicle before the next flight, and update its firmware",
    )
    COMMAND_FAILED = (
        "the vehicle does not {command}: {answer}",
        "Only with `--on-board`: the vehicle's own commander answered with an error, or not at all.",
        "check the radio link, restart the vehicle before the next flight, and update its firmware",
    )
    PILOT_FAULT = (
        "fault in the pilot: {error!r}",
        "A fault of cfplan. In the air the vehicle lands; if landing fails too, the motors are cut.",
        "please report this, with the record",
    )

    def __init__(self, text: str, meaning: str, cure: str, exit_code: ExitCode = ExitCode.ENDED_BY_SAFETY):
        self.text, self.meaning, self.cure, self.exit_code = text, meaning, cure, exit_code

    def abort(self, rung: Rung, **values: object) -> Abort:
        """Return the abort of this reason with the values of its message's fields."""
        return Abort(rung, self.exit_code, self.text.format(**values), self.cure)
