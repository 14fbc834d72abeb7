"""Sentences that summarise a result."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Summary:
    """Sentences about where v3dg is better, by how much and at which error; and about
    where it is not."""

    wins: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)

    def judge(self, is_win: bool, sentence: str) -> None:
        (self.wins if is_win else self.losses).append(sentence)
