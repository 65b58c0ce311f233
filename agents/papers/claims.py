"""Claims of a paper: what it says, the conditions that the runs must meet, and the verdict."""

from __future__ import annotations

import inspect
import string
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from agents.papers.numbers import cite, number_text, percent

Verdict = Literal[
    "holds",
    "fails under the readings tried",
    "depends on what the text leaves open",
    "misprint, or lost in our copy of the text",
    "undecided",
]
HOLDS, FAILS, DEPENDS, MISPRINT, UNDECIDED = get_args(Verdict)


Test = Callable[..., Any]


class Claim(NamedTuple):
    """A claim of a paper: its sentence, where it stands, its evidence and its test.

    ``test`` takes the data of the pieces that its arguments name, under one reading. It returns the
    conditions: a condition, an array of conditions, or a list of both, each 1, 0 or NaN for
    undecided; a mapping of these by what the sentence leaves open; or ``MISPRINT``. It may return a
    mapping of numbers with them. ``evidence`` is a text with fields for ``str.format``, which name
    these numbers or the data of the pieces.
    """

    text: str
    source: str
    evidence: str
    test: Test

    def judge(self, runs: Mapping[str, Mapping[str, Any]]) -> Judgement:
        """Return the verdict from the data of all pieces by reading, the environment's first."""
        outcomes, conditions, values = dict[str, float](), None, dict[str, Any]()
        for reading, data in [*runs.items()][::-1]:
            values = {name: data[name] for name in inspect.signature(self.test).parameters}
            conditions = self.test(**values)
            if isinstance(conditions, tuple):
                conditions, numbers = conditions
                values |= numbers
            cases = conditions if isinstance(conditions, Mapping) else {"": conditions}
            for case, parts in cases.items():
                if not isinstance(parts, str):
                    outcomes[f"{reading}: {case}" if case else reading] = outcome(parts)
        own = MISPRINT if isinstance(conditions, str) else verdict(outcomes.values())
        return Judgement(self, own, _Evidence().vformat(self.evidence, (), values), outcomes)


class _Evidence(string.Formatter):
    """Fields of samples as means with intervals; with ``%`` shares in per cent."""

    def format_field(self, value: Any, spec: str) -> str:
        if spec == "%":
            return percent(value)
        if spec:
            return number_text(value, spec)
        return cite(value) if isinstance(value, list | tuple | np.ndarray) else str(value)


class Claims(list[Claim]):
    """The claims of a paper in the order of its page."""

    def add(self, source: str) -> Callable[[Test], Test]:
        """Return a decorator that adds a test, whose docstring is sentence and evidence."""

        def decorate(test: Test) -> Test:
            text, _, evidence = inspect.cleandoc(test.__doc__ or "").partition("\n\n")
            self.append(Claim(" ".join(text.split()), source, " ".join(evidence.split()), test))
            return test

        return decorate


class Judgement(NamedTuple):
    """A claim with its verdict, its evidence, and the outcome under each reading."""

    claim: Claim
    verdict: Verdict
    evidence: str
    outcomes: Mapping[str, float]

    @property
    def region(self) -> str:
        """The readings under which a claim holds that depends on them."""
        names = [name.rpartition(": ")[2] for name, value in self.outcomes.items() if value == 1.0]
        ways = ", ".join(dict.fromkeys(names))
        return f": holds with {ways}" if self.verdict == DEPENDS else ""


def outcome(parts: Any) -> float:
    """Return 1 if all conditions of a claim hold, 0 if one of them fails, and else NaN.

    Args:
        parts: A condition, an array of conditions, or a list of both: 1, 0 or NaN for undecided.
    """
    entries = parts if isinstance(parts, list | tuple) else [parts]
    result = np.concatenate([np.ravel(np.asarray(entry, dtype=float)) for entry in entries])
    return 0.0 if (result == 0.0).any() else float(result.min())


def verdict(outcomes: Iterable[float]) -> Verdict:
    """Return the verdict on a claim from its outcomes under the readings of the text."""
    different = set(np.nan_to_num(list(outcomes), nan=0.5).tolist())
    if {0.0, 1.0} <= different:
        return DEPENDS
    return {1.0: HOLDS, 0.0: FAILS}[different.pop()] if different in ({0.0}, {1.0}) else UNDECIDED
