"""Proposals: where the pilot finds what a planner proposes, and answers it. The pilot never waits for a planner."""

from collections.abc import Callable
from typing import Protocol

from cfplan.flight.setpoints.commitment import Commitment, Proposal, Refusal


class ProposalSource(Protocol):
    """A planner as the pilot sees it."""

    def newest(self) -> Proposal | None:
        """Return the newest proposal since the last call, None where there is none. Must not wait."""

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        """Tell the planner what became of a proposal. Must not wait."""


class NoProposals:
    """No planner: the flight is that of its mission."""

    def newest(self) -> Proposal | None:
        return None

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        pass


NO_PROPOSALS = NoProposals()


class HeldProposals:
    """The newest proposal, given by code in the pilot's own process; `on_answer` hears what became of each."""

    def __init__(self, on_answer: Callable[[Proposal, Commitment | Refusal], None] = lambda *_: None):
        self._newest: Proposal | None = None
        self.on_answer = on_answer

    def give(self, proposal: Proposal) -> None:
        """Propose; a proposal that was not taken yet is forgotten."""
        self._newest = proposal

    def newest(self) -> Proposal | None:
        proposal, self._newest = self._newest, None
        return proposal

    def answer(self, proposal: Proposal, answer: Commitment | Refusal) -> None:
        self.on_answer(proposal, answer)
