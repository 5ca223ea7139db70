"""cfplan: plan, certify, rehearse, fly and replay time-optimal Crazyflie flights."""

from typing import TYPE_CHECKING, Any

from cfplan.version import __version__

if TYPE_CHECKING:
    from cfplan.steering.connect import connect

__all__ = ["__version__", "connect"]


def __getattr__(name: str) -> Any:
    """Import what programs use when they ask for it: commands must begin at once."""
    if name == "connect":
        from cfplan.steering.connect import connect

        return connect
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
