"""curate check: run all rules of the leakage firewall."""

from pipelines.commands.options import JsonOption, WorkspaceOption


def check(workspace: WorkspaceOption = None, as_json: JsonOption = False) -> None:
    """Check that no ground truth leaks into pseudo-labels or training; nothing is changed.

    Every export and every training first checks the same rules on a sample of frames. The exit code
    is 5 if a rule is broken.

    Example: curate check
    """
    from curate.errors import LeakageError
    from pipelines.commands.options import open_workspace
    from pipelines.firewall.rules import check as check_all
    from pipelines.reports.terminal import print_json, print_line

    findings = []
    for finding in check_all(open_workspace(workspace)):
        findings.append(finding)
        if not as_json:
            print_line(
                f"{'pass' if finding.passed else 'FAIL'}  {finding.rule:<36} {finding.message}", 6
            )
    if as_json:
        print_json(findings)
    broken = [finding for finding in findings if not finding.passed]
    if broken:
        first = broken[0]
        raise LeakageError(
            f"{len(broken)} of {len(findings)} rules are broken; {first.rule}: {first.message}; "
            f"{first.remedy or 'see above'}"
        )
