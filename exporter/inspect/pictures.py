"""``inspect --logdir`` and ``--svg``: a source's graph for TensorBoard, and its policies as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from export_model.converters.formats.bundle.bundle import distinct_names, writing
from export_model.signatures.contract import safe_name
from export_model.signatures.errors import BundleError, UsageError

if TYPE_CHECKING:
    from export_model.exporter.inspect.inspection import Inspection


def write_pictures(inspection: Inspection, logdir: Path | None = None, svg: Path | None = None) -> list[Path]:
    """Write what was asked for; the files that were written. Raises BundleError, UsageError.

    ``logdir`` gets a folder per model (a run, as TensorBoard calls it); ``svg`` is a file, or one per policy
    (``policy-NAME.svg``) where there are several. Files of an earlier call are replaced.
    """
    files: dict[Path, bytes] = {}
    if logdir is not None:
        if not inspection.graphs:
            raise UsageError(f"--logdir {logdir}: the source has no graph", fix="give the file of a policy")
        from export_model.converters.formats.tensorboard import FILE_NAME, event_file

        distinct_names([(name, f"model {i}") for i, (name, _) in enumerate(inspection.graphs)])
        files.update({logdir / name / FILE_NAME: event_file(graph) for name, graph in inspection.graphs})
    if svg is not None:
        from export_model.exporter.reports.picture import picture

        policies = [inspected.policy for inspected in inspection.policies]
        several = len(policies) > 1
        for policy in policies:
            own = safe_name(policy.name).removeprefix(f"{svg.stem}-")
            place = svg.with_name(f"{svg.stem}-{own}{svg.suffix}") if several else svg
            files[place] = picture(policy).encode()
    for path in files:
        # What was asked for by its whole path is the user's own link; a name that the source says may be a trap.
        named = [p for p in (path, path.parent) if p not in (svg, logdir) and (p is path or p.parent == logdir)]
        link = next((p for p in named if p.is_symlink()), None)
        if link is not None:
            raise BundleError(
                "is a link",
                where=str(link),
                why="links in a folder that anyone may have made are not written through",
                fix="remove it, or name another folder",
            )
    for path, data in files.items():
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    return list(files)
