"""curate check: run all rules of the leakage firewall."""

from pipelines.commands.options import JsonOption, WorkspaceOption


def check(workspace: WorkspaceOption = None, as_json: JsonOption = False) -> None:
    """Check that no ground truth leaks into pseudo-labels or training; nothing is changed.

    Every export and every training first checks the same rules on a sample of frames. The exit code
    is 5 if a rule is broken. The category names of label files, detector, segmenter and settings
    are compared too; names that no work can start with end in exit code 2.

    Example: curate check
    """
    from curate.errors import ConfigError, LeakageError
    from pipelines.category_names import all_differences
    from pipelines.commands.options import open_workspace
    from pipelines.firewall.finding import Finding
    from pipelines.firewall.rules import check as check_all
    from pipelines.reports.terminal import print_json, print_line

    opened = open_workspace(workspace)
    findings = []
    for finding in check_all(opened):
        findings.append(finding)
        if not as_json:
            state = "pass" if finding.passed else "FAIL"
            print_line(f"{state}  {finding.rule:<36} {finding.message}", 6)
    differences = all_differences(opened)
    rule = "category names agree"
    if as_json:
        names = [Finding(rule, not each.wrong, each.message) for each in differences]
        print_json([*findings, *names])
    else:
        for each in differences:
            print_line(f"{'FAIL' if each.wrong else 'warn'}  {rule:<36} {each.message}", 6)
        if not differences:
            print_line(f"pass  {rule:<36} label files, detector, segmenter and settings", 6)
    broken = [finding for finding in findings if not finding.passed]
    if broken:
        first = broken[0]
        raise LeakageError(
            f"{len(broken)} of {len(findings)} rules are broken; {first.rule}: {first.message}; "
            f"{first.remedy or 'see above'}"
        )
    if wrong := [each.message for each in differences if each.wrong]:
        raise ConfigError(f"{rule}: {wrong[0]}")
