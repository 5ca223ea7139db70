"""Connect to a Crazyflie within bounded time, or fail with a hint."""

import threading
from collections.abc import Callable, Sequence
from functools import partial

from cfplan.errors import LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.radio.crazyradio import usb_hint
from cfplan.flight.radio.dongle import open_dongle
from cfplan.flight.radio.link import Link
from cfplan.flight.radio.parameter_tables import disk_table_cache
from cfplan.flight.radio.radio_lock import lock_radio
from cfplan.flight.radio.restart import restart_vehicle
from cfplan.flight.radio.session import Session
from cfplan.flight.radio.transport import DriverTransport, Transport, register_drivers
from cfplan.flight.radio.uri import EXAMPLES
from cfplan.flight.telemetry import Telemetry

FIRST_ANSWER_TIMEOUT = 4.0  # s, from opening the link to the first answer
_LOOK_PERIOD = 0.02  # s


def connect(
    uri: str,
    report: Callable[[Telemetry], None],
    drivers: Sequence[type] = (),
    *,
    waiting: Callable[[], None] = lambda: None,
    clock: Clock = REAL_CLOCK,
    patience: float = FIRST_ANSWER_TIMEOUT,
) -> Link:
    """Connect, and release what an earlier connection left set on the vehicle.

    `drivers` are cflib link drivers tried before cflib's own. `waiting` is called while waiting, and may raise.
    Raises LinkError, after `patience`, s, and within 1 s more, if nothing answers.
    """
    lock, end = lock_radio(uri), clock.now() + patience
    register_drivers(drivers)
    opening = _Opening(uri, clock)
    try:
        session = Session(opening.wait(patience, waiting), uri, clock, waiting)
        _open(session, end - clock.now())
    except BaseException:
        opening.abandon()
        if lock is not None:
            lock.close()
        raise
    link = Link(session, report, partial(restart_vehicle, uri, clock), lock)
    link.release_priority()
    return link


def _open(session: Session, patience: float) -> None:
    try:
        session.open(patience, disk_table_cache())
    except LinkError as error:
        if session.lost:
            raise _unreachable(session.uri, session.lost) from error
        if session.protocol < 0:
            raise _silent(session.uri) from error
        raise


class _Opening:
    """A transport that opens in a thread, as a driver may block on a host that does not answer."""

    def __init__(self, uri: str, clock: Clock):
        self._uri, self._clock = uri, clock
        self._transport: Transport | None = None
        self._error: Exception | None = None
        self._abandoned = False
        self._done = threading.Event()
        threading.Thread(target=self._open, name="opening the link", daemon=True).start()

    def _open(self) -> None:
        try:
            dongle = self._uri.startswith("radio://")
            self._transport = open_dongle(self._uri, self._clock) if dongle else DriverTransport(self._uri)
        except Exception as error:  # cflib and pyusb raise many types
            self._error = error
        self._done.set()
        if self._abandoned:
            self._close()

    def wait(self, patience: float, waiting: Callable[[], None]) -> Transport:
        """Return the transport once it is open. Raises LinkError if it is not within `patience`, s."""
        end = self._clock.now() + patience
        while not self._done.is_set() and self._clock.now() < end:
            waiting()
            self._clock.wait(self._done, _LOOK_PERIOD)
        if self._error is not None:
            reason = self._error.what if isinstance(self._error, LinkError) else str(self._error)
            raise _unreachable(self._uri, reason) from self._error
        if self._transport is None:
            raise _silent(self._uri)
        return self._transport

    def abandon(self) -> None:
        """Close the transport, now or as soon as it is open."""
        self._abandoned = True
        threading.Thread(target=self._close, daemon=True).start()

    def _close(self) -> None:
        if self._transport is not None:
            self._transport.close()


def _silent(uri: str) -> LinkError:
    return LinkError("nothing answers", where=uri, hint=_hint(uri, ""))


def _unreachable(uri: str, reason: str) -> LinkError:
    return LinkError(
        f"cannot connect: {(reason.splitlines() or ['no reason given'])[0]}", where=uri, hint=_hint(uri, reason)
    )


def _hint(uri: str, reason: str) -> str:
    if "No driver" in reason or "malformed" in reason:
        return f"a URI looks like {EXAMPLES}"
    if by_usb := usb_hint(None, reason):
        return by_usb
    if uri.startswith("radio://") and ("dongle" in reason.lower() or "backend" in reason.lower()):
        return "plug a Crazyradio in; `cfplan doctor` shows what is found"
    if uri.startswith("radio://"):
        return "is the Crazyflie on, and are channel, rate and address right?"
    if uri.startswith("usb://"):
        return "is the Crazyflie on and on a cable? `lsusb` must list it"
    return "is the other end running?"
