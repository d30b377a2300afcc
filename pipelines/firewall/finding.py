"""The result of a firewall rule."""

from dataclasses import dataclass

from curate.errors import LeakageError


@dataclass(frozen=True)
class Finding:
    """The result of one rule.

    Attributes:
        rule: what must hold, in a few words.
        passed: whether it holds.
        message: figures if it holds, or else what breaks it.
        remedy: what to do if it does not hold.
    """

    rule: str
    passed: bool
    message: str
    remedy: str = ""


def raise_finding(finding: Finding) -> None:
    """Raise LeakageError if a rule is broken."""
    if not finding.passed:
        raise LeakageError(f"{finding.rule}: {finding.message}; {finding.remedy}")
