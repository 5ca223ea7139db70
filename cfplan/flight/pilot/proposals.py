"""Proposals of a planner, as the pilot receives and answers them. The pilot never waits for a planner."""

import contextlib
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Protocol

from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.setpoints.commitment import Commitment, Proposal, Refusal

LONGEST_MESSAGE = 1 << 26  # bytes, of a proposal: five minutes of flight
NEXT_PART_TIMEOUT = 5.0  # s at rest before the end of a plan, after which its next part is not awaited any longer
LOOKS_UNTIL = 0.003  # s before a setpoint is due: proposals that arrive later wait until it is sent
# kind; checksums of proposal and commitment; time, s, of setpoint 0 or of the proposal's arrival
_ANSWER = struct.Struct("<8sIId")
_BEGUN, _ACCEPTED, _REFUSED = b"begun   ", b"accepted", b"refused "


class ProposalSource(Protocol):
    """A planner as the pilot sees it."""

    def begin(self, start: float) -> None:
        """Tell the planner that setpoint 0 is due at `start`, s on the flight's clock. Must not wait."""

    def wait(self, patience: float) -> bool:
        """Wait for a proposal, at most for `patience`, s; return whether there is one, or False at once if none
        arrives between the pilot's ticks.
        """

    def newest(self) -> Proposal | None:
        """Return the newest proposal since the last call, None where there is none. Must not wait."""

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        """Answer a proposal. Must not wait."""


class NoProposals:
    """No planner: the mission is flown as it is."""

    def begin(self, start: float) -> None:
        pass

    def wait(self, patience: float) -> bool:
        return False

    def newest(self) -> Proposal | None:
        return None

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        pass


NO_PROPOSALS = NoProposals()


class HeldProposals:
    """The newest proposal, given by code in the pilot's own process; `on_answer` gets the answers."""

    def __init__(self, on_answer: Callable[[Proposal, Commitment | Refusal], None] = lambda *_: None):
        self._newest: Proposal | None = None
        self.on_answer = on_answer

    def begin(self, start: float) -> None:
        pass

    def give(self, proposal: Proposal) -> None:
        """Propose; replaces a proposal that was not taken yet."""
        self._newest = proposal

    def wait(self, patience: float) -> bool:
        return False

    def newest(self) -> Proposal | None:
        proposal, self._newest = self._newest, None
        return proposal

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        self.on_answer(proposal, answer)


class ReceivedProposals(HeldProposals):
    """Proposals of a planner's process, read by a thread; another thread answers it.

    A planner that died, hangs or sends something else counts as one that proposes nothing.
    """

    def __init__(self, connection: Connection, clock: Clock = REAL_CLOCK):
        super().__init__(self._answer)
        self._connection, self._clock = connection, clock
        self._answers: SimpleQueue[bytes] = SimpleQueue()
        self._came = (0, 0.0)  # checksum and arrival, s, of the last proposal
        self._given = threading.Event()
        threading.Thread(target=self._read, name="proposals", daemon=True).start()
        threading.Thread(target=self._write, name="answers", daemon=True).start()

    def give(self, proposal: Proposal) -> None:
        super().give(proposal)
        self._given.set()

    def wait(self, patience: float) -> bool:
        return self._clock.wait(self._given, patience)

    def newest(self) -> Proposal | None:
        self._given.clear()
        return super().newest()

    def begin(self, start: float) -> None:
        self._answers.put(_ANSWER.pack(_BEGUN, 0, 0, start))

    def _answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        checksum, came = self._came
        came = came if checksum == proposal.checksum else 0.0
        if isinstance(answer, Commitment):
            self._answers.put(_ANSWER.pack(_ACCEPTED, proposal.checksum, answer.checksum, came))
        else:
            self._answers.put(_ANSWER.pack(_REFUSED, proposal.checksum, 0, came) + str(answer).encode())

    def _read(self) -> None:
        with contextlib.suppress(EOFError, OSError, TypeError):  # TypeError: closed here while it was read
            while True:
                message, proposal = self._connection.recv_bytes(LONGEST_MESSAGE), None
                with contextlib.suppress(Exception):  # skip a message that cannot be read
                    proposal = Proposal.of_bytes(message)
                if proposal is not None:
                    self._came = proposal.checksum, self._clock.now()
                    self.give(proposal)

    def _write(self) -> None:
        with contextlib.suppress(OSError, TypeError):
            while True:
                self._connection.send_bytes(self._answers.get())


@dataclass(frozen=True, slots=True)
class PilotAnswer:
    """A message of the pilot to a planner."""

    begun: float | None = None  # s, when setpoint 0 is due, in the message that says so
    proposal: int = 0  # checksum of the proposal that is answered
    commitment: int | None = None  # checksum of the new commitment; None if the proposal was refused
    came: float = 0.0  # s, arrival of the proposal at the pilot; 0 if another arrived meanwhile
    reason: str = ""  # why it was refused


def read_answer(message: bytes) -> PilotAnswer:
    """Return the pilot's message to a planner. Raises ValueError if it is not one."""
    if len(message) < _ANSWER.size:
        raise ValueError(f"an answer of {len(message)} bytes")
    kind, proposal, commitment, time = _ANSWER.unpack_from(message)
    match kind:
        case b"begun   ":
            return PilotAnswer(begun=time)
        case b"accepted":
            return PilotAnswer(proposal=proposal, commitment=commitment, came=time)
        case b"refused ":
            return PilotAnswer(proposal=proposal, came=time, reason=message[_ANSWER.size :].decode())
    raise ValueError(f"an answer of the kind {kind!r}")
