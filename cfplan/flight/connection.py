"""Connecting to a Crazyflie, within bounds of time, and refusing with a hint what cannot be reached."""

import os
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cfplan.errors import LinkError
from cfplan.flight.link import Link
from cfplan.flight.telemetry import Telemetry

FIRST_ANSWER = 4.0  # s, from opening the link to the first packet
WHOLE_CONNECTION = 30.0  # s, to the last parameter, over a lossy radio without a cache


def connect(
    uri: str,
    report: Callable[[Telemetry], None],
    drivers: Sequence[type] = (),
    *,
    waiting: Callable[[], None] = lambda: None,
) -> Link:
    """Connect, and take the vehicle out of whatever an earlier connection left it in.

    `drivers` are cflib link drivers tried before cflib's own. `waiting` is called while nothing happens, and may raise.
    Raises LinkError, within 5 s where nothing answers.
    """
    from cflib import crtp
    from cflib.crazyflie import Crazyflie

    if not crtp.CLASSES:
        crtp.init_drivers()
    for driver in reversed(drivers):
        if driver not in crtp.CLASSES:
            crtp.CLASSES.insert(0, driver)

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
            crazyflie.link = _Serialized(crazyflie.link)

    threading.Thread(target=open_link, daemon=True).start()
    try:
        _wait(answered, failed, FIRST_ANSWER, waiting)
        if not failed.is_set() and not answered.is_set():
            raise LinkError("nothing answers", where=uri, hint=_hint(uri, ""))
        _wait(complete, failed, WHOLE_CONNECTION, waiting)
        if failed.is_set():
            reason = reasons[0].splitlines()[0].removeprefix("Couldn't load link driver: ")
            raise LinkError(f"cannot connect: {reason}", where=uri, hint=_hint(uri, reason))
        if not complete.is_set():
            raise LinkError("the vehicle answers, but its tables do not come through", where=uri,
                            hint="move closer, or choose a freer channel")  # fmt: skip
    except BaseException:
        threading.Thread(target=crazyflie.close_link, daemon=True).start()
        raise

    link = Link(crazyflie, uri, report)

    def note_loss(_: str, reason: str = "the link was closed") -> None:
        link.lost = link.lost or reason

    crazyflie.disconnected.callbacks.insert(0, note_loss)
    crazyflie.connection_lost.add_callback(note_loss)
    link.release_priority()
    link.ask_firmware()
    return link


def _wait(done: threading.Event, failed: threading.Event, patience: float, waiting: Callable[[], None]) -> None:
    end = time.monotonic() + patience
    while not (done.is_set() or failed.is_set()) and time.monotonic() < end:
        waiting()
        done.wait(0.02)


def _hint(uri: str, reason: str) -> str:
    if "No driver" in reason or "malformed" in reason:
        return "a URI looks like radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:19850 or sim://0"
    if uri.startswith("radio://") and ("dongle" in reason.lower() or "backend" in reason.lower()):
        return "plug a Crazyradio in; `cfplan doctor` shows what is found"
    if uri.startswith("radio://"):
        return "is the Crazyflie on, and are channel, rate and address right?"
    return "is the other end running?"


def _table_cache() -> str | None:
    """Where cflib keeps the vehicle's tables between connections; None where nothing can be written."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "cfplan" / "tables"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(folder) if os.access(folder, os.W_OK) else None


class _Serialized:
    """A link driver that sends for one thread at a time, and gives a packet up rather than wait for a stuck one."""

    def __init__(self, driver: Any):
        self._driver, self._lock = driver, threading.Lock()
        self.needs_resending = driver.needs_resending

    def send_packet(self, packet: Any) -> None:
        if self._lock.acquire(timeout=0.1):
            try:
                self._driver.send_packet(packet)
            finally:
                self._lock.release()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)
