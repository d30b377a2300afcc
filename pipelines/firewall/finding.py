"""What a rule of the firewall answers."""

from dataclasses import dataclass

from curate.errors import LeakageError


@dataclass(frozen=True)
class Finding:
    """What became of one rule.

    Attributes:
        rule: what must hold, in a few words.
        held: whether it does.
        told: with what numbers, or what breaks it.
        remedy: what to do where it is broken.
    """

    rule: str
    held: bool
    told: str
    remedy: str = ""


def raise_finding(finding: Finding) -> None:
    """Raise LeakageError if a rule is broken."""
    if not finding.held:
        raise LeakageError(f"{finding.rule}: {finding.told}; {finding.remedy}")
