"""Connect to a Crazyflie within bounded time, or fail with a hint."""

import os
import queue
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cfplan.errors import LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.radio.crazyradio import usb_hint
from cfplan.flight.radio.link import Link
from cfplan.flight.radio.perishable import PerishableQueue, empty_air
from cfplan.flight.radio.radio_lock import lock_radio
from cfplan.flight.radio.uri import EXAMPLES
from cfplan.flight.telemetry import Telemetry

FIRST_ANSWER = 4.0  # s, from opening the link to the first packet
WHOLE_CONNECTION = 30.0  # s, to the last parameter, over a lossy radio without a cache
PATIENCE = 0.005  # s that a packet waits in flight for a busy radio; then it is dropped, as the next one is fresher
_DEAD_AFTER = 1.0  # s that a packet of cflib's own waits for the radio; after 2 s the driver would end the link
_RETRIES = 5000  # transmissions that may fail in a row, about 10 s: a vehicle that hovers alone is worth waiting for


def connect(
    uri: str,
    report: Callable[[Telemetry], None],
    drivers: Sequence[type] = (),
    *,
    waiting: Callable[[], None] = lambda: None,
    clock: Clock = REAL_CLOCK,
    patience: float = FIRST_ANSWER,
) -> Link:
    """Connect, and end the state in which an earlier connection left the vehicle.

    `drivers` are cflib link drivers tried before cflib's own. `waiting` is called while nothing happens, and may raise.
    Raises LinkError, after `patience`, s, and within 1 s more, if nothing answers.
    """
    from cflib import crtp
    from cflib.crazyflie import Crazyflie
    from cflib.crtp.radiodriver import set_retries_before_disconnect
    from cflib.crtp.udpdriver import UdpDriver

    if UdpDriver not in crtp.CLASSES:  # one of cflib's own; there may be others' already
        crtp.init_drivers()
    for driver in reversed(drivers):
        if driver not in crtp.CLASSES:
            crtp.CLASSES.insert(0, driver)

    lock = lock_radio(uri)
    set_retries_before_disconnect(_RETRIES)
    answered, complete, failed = threading.Event(), threading.Event(), threading.Event()
    reasons: list[str] = []

    def fail(_: str, reason: str = "the link was closed") -> None:
        reasons.append(reason)
        failed.set()

    crazyflie = Crazyflie(rw_cache=_table_cache())
    crazyflie.link_established.add_callback(lambda _: answered.set())
    crazyflie.fully_connected.add_callback(lambda _: complete.set())
    crazyflie.connection_failed.add_callback(fail)
    crazyflie.disconnected.callbacks.insert(0, fail)  # before cflib's own, one of which may never return

    def open_link() -> None:
        crazyflie.open_link(uri)
        if crazyflie.link is not None:
            empty_air(crazyflie.link, clock.now)
            crazyflie.link = SerializedDriver(crazyflie.link, clock)

    threading.Thread(target=open_link, daemon=True).start()
    try:
        _wait(answered, failed, patience, waiting, clock)
        if not failed.is_set() and not answered.is_set():
            raise LinkError("nothing answers", where=uri, hint=_hint(uri, ""))
        _wait(complete, failed, WHOLE_CONNECTION, waiting, clock)
        if failed.is_set():
            reason = reasons[0].splitlines()[0].removeprefix("Couldn't load link driver: ")
            raise LinkError(f"cannot connect: {reason}", where=uri, hint=_hint(uri, reason))
        if not complete.is_set():
            raise LinkError("the vehicle answers, but its tables do not come through", where=uri,
                            hint="move closer, or choose a freer channel")  # fmt: skip
    except BaseException:
        if lock is not None:
            lock.close()
        threading.Thread(target=crazyflie.close_link, daemon=True).start()
        raise

    link = Link(crazyflie, uri, report, clock, radio_lock=lock)
    crazyflie.disconnected.callbacks.insert(0, link.note_loss)
    crazyflie.connection_lost.add_callback(link.note_loss)
    link.release_priority()
    link.ask_firmware()
    return link


def _wait(
    done: threading.Event, failed: threading.Event, patience: float, waiting: Callable[[], None], clock: Clock
) -> None:
    end = clock.now() + patience
    while not (done.is_set() or failed.is_set()) and clock.now() < end:
        waiting()
        clock.wait(done, 0.02)


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


def _table_cache() -> str | None:
    """Return the folder where cflib keeps the vehicle's tables between connections; None where it cannot write."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "cfplan" / "tables"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


class SerializedDriver:
    """A link driver that sends for one thread at a time, and in flight drops a packet rather than wait for long.

    cflib's radio driver has a queue of one and waits for 2 s if the radio is dead. A setpoint or a pose that waited
    that long would be taken for a fresh one.
    """

    def __init__(self, driver: Any, clock: Clock = REAL_CLOCK):
        self._driver, self._lock = driver, threading.Lock()
        waiting = getattr(driver, "out_queue", None)
        self._queue = PerishableQueue(waiting, clock.now) if isinstance(waiting, queue.Queue) else None

    @property
    def needs_resending(self) -> bool:
        """Return whether cflib must repeat unanswered packets, which the driver finds out after connecting."""
        return bool(self._driver.needs_resending)

    def send_packet(self, packet: Any) -> None:
        """Send a packet for cflib itself; drop it where the radio is dead for long, as cflib would give the link up."""
        if self._lock.acquire(timeout=0.1):
            try:
                if self._queue is not None:
                    self._queue.put(packet, _DEAD_AFTER)
                else:
                    self._driver.send_packet(packet)
            finally:
                self._lock.release()

    def send_soon(self, packet: Any) -> None:
        """Send a packet that is soon out of date; drop it if the radio is busy."""
        if self._queue is not None:
            self._queue.put(packet, PATIENCE)
        else:
            self.send_packet(packet)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)
