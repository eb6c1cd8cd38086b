"""What is said of a log, in a terminal: lines of text."""

from __future__ import annotations

from export_model.exporter.logs.check import LogReport
from export_model.exporter.tables import count_text


def report_lines(report: LogReport) -> list[str]:
    """What was found, without the last line."""
    lines = [f"{report.policy}: {report.log}, {_steps(report)} of {count_text(report.episodes, 'episode')}"]
    lines += [f"  note: {note}" for note in report.notes]
    misfits = int(report.misfits.sum())
    if misfits:
        lines.append(
            f"  {misfits} of {_steps(report)} differ from what the policy answers, the first is {report.first}"
        )
    if report.worst is not None:
        worst = report.worst
        both = f"logged {worst.logged:.6g}, the policy answers {worst.computed:.6g}"
        lines.append(f"  farthest at step {worst.step}: {worst.column}: {both}")
    for name, sigmas in report.sigmas.items():
        lines.append(f"  {name}: the odds of what was drawn are {abs(sigmas):.1f} σ {_side(sigmas)} what is expected")
    for cause in report.causes:
        lines.append(f"  cause: {cause.where}: {cause.says}")
    if report.causes and not report.drawn:
        them = "it" if len(report.causes) == 1 else "them"
        lines.append(f"  with {them} {report.explained} of {_steps(report)} fit")
    for cause in report.others:
        lines.append(f"  explains as much: {cause.where}: {cause.says}")
    return lines


def sentence(report: LogReport) -> str:
    """The verdict, one sentence."""
    if report.fits:
        how = "can have been drawn by the policy" if report.drawn else "are what the policy answers"
        return f"FITS: the actions of all {_steps(report)} {how} (run in {report.runtime})"
    if report.causes:
        kinds = ", ".join(dict.fromkeys(c.kind.replace("_", " ") for c in report.causes))
        return f"DIFFERENT, most likely because of: {kinds} ({', '.join(c.where for c in report.causes[:3])})"
    return "DIFFERENT: none of the causes that are known explains it"


def _steps(report: LogReport) -> str:
    return count_text(report.steps, "step")


def _side(sigmas: float) -> str:
    return "below" if sigmas < 0 else "above"
