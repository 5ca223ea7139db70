"""Upload to the vehicle's trajectory memory by cflib, read back: what it then holds is for the caller to compare."""

import threading
from typing import Any

from cfplan.errors import LinkError
from cfplan.flight.clock import Clock

PATIENCE = 30.0  # s for 4,096 bytes there and back, which take some 340 packets
_SLICE = 0.1  # s


def upload(crazyflie: Any, content: bytes, uri: str, clock: Clock, patience: float = PATIENCE) -> bytes:
    """Write the beginning of the memory of a connected `cflib.crazyflie.Crazyflie`, and return what it holds there.

    Raises LinkError if it has no such memory, or does not take or give all of it within `patience`, s.
    """
    from cflib.crazyflie.mem import MemoryElement

    memories = crazyflie.mem
    memory = next(iter(memories.get_mems(MemoryElement.TYPE_TRAJ)), None)
    if memory is None:
        raise LinkError("the vehicle has no trajectory memory", where=uri, hint="update its firmware")
    end, done, failed, held = clock.now() + patience, threading.Event(), threading.Event(), bytearray()

    def take(found: Any, _: int, data: bytes) -> None:
        if found.id == memory.id:
            held.extend(data)
            done.set()

    def fail(found: Any, *_: Any) -> None:
        if found.id == memory.id:
            failed.set()

    def wait(what: str) -> None:
        while not (done.is_set() or failed.is_set()) and clock.now() < end:
            clock.wait(done, _SLICE)
        if failed.is_set() or not done.is_set():
            why = "refuses" if failed.is_set() else "does not answer while"
            raise LinkError(f"the vehicle {why} {what} its trajectory memory", where=uri,
                            hint="check the radio link, and restart the vehicle")  # fmt: skip
        done.clear()

    memory.trajectory = [_Packed(content)]
    memory.write_data(lambda *_: done.set(), fail)
    wait("writing")
    memories.mem_read_cb.add_callback(take)
    memories.mem_read_failed_cb.add_callback(fail)
    try:
        memories.read(memory, 0, len(content))
        wait("reading")
    finally:
        memories.mem_read_cb.remove_callback(take)
        memories.mem_read_failed_cb.remove_callback(fail)
    return bytes(held)


class _Packed:
    """Bytes for cflib, which asks its elements for them."""

    def __init__(self, content: bytes):
        self._content = content

    def pack(self) -> bytearray:
        return bytearray(self._content)
