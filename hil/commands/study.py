"""``hil study NAME``: a ready-made study, from its runs to a page with maps and sentences; ``hil study list``."""

from __future__ import annotations

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from hil.commands.arguments import positive
from hil.errors import EXIT_STABLE

LIST = "list"


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("study", help="answer a question of a source by sweeps and linear loops; list them")
    parser.add_argument("name", nargs="?", default=LIST, metavar="NAME", help="of the study; list: what there is")
    parser.add_argument("--quick", action="store_true", help="few points: a look in two minutes")
    parser.add_argument("--jobs", type=positive, metavar="N", help="processes at once (default: one per core)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="directory of page, maps and tables (default: runs/…); with the same command a study that was ended goes "
        "on there",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_study)


def _study(options: argparse.Namespace) -> int:
    from hil.lab.extras import require
    from hil.studies import named

    if options.name == LIST:
        return _list(options.json)
    study = named(options.name)
    require("pyarrow.parquet")
    from hil.lab.workers import default_jobs, parallel
    from hil.report.progress import Counter
    from hil.report.study_page import columns, sentences, write_study

    out = options.out or Path("runs") / f"{study.name}-study-{time.strftime('%Y%m%d-%H%M%S')}"
    parts = study.parts(options.quick)
    counts = {part.name: part.count() for part in parts}
    done = dict.fromkeys(counts, 0)
    began = time.monotonic()
    with Counter(f"study {study.name}", sum(counts.values()), "answers", sys.stderr) as progress:

        def told(part: str, so_far: int) -> None:
            done[part] = so_far
            progress.show(sum(done.values()), part)

        try:
            answers, findings = study.run(
                out, partial(parallel, jobs=options.jobs or default_jobs()), options.quick, told
            )
        except KeyboardInterrupt:
            print(f"hil: ended; the same command with --out {out} goes on", file=sys.stderr)
            raise
    what = [
        f"{part.name}: {part.scenario} {' '.join(f'--set {text}' for text in part.settings)} "
        f"{' '.join(f'--vary {text}' for text in part.vary)}: {counts[part.name]} {type(part).__name__.lower()}"
        for part in parts
    ]
    page = write_study(out, study, findings, what)
    if options.json:
        record = {
            "study": study.name, "quick": options.quick, "wall": time.monotonic() - began, **findings.record(),
            "answers": {
                name: {"axes": {a.quantity.key: list(a.values) for a in part.axes}, "rows": part.rows}
                for name, part in answers.items()
            },
            "page": str(page),
        }  # fmt: skip
        print(json.dumps(record, allow_nan=False))
        return EXIT_STABLE
    for table in findings.tables:
        print("\n".join(columns(table)), end="\n\n")
    print("\n".join(sentences(findings)), end="\n\n")
    print(f"time        {time.monotonic() - began:.0f} s")
    print(f"page        {page}")
    return EXIT_STABLE


def _list(as_json: bool) -> int:
    from hil.studies import STUDIES

    if as_json:
        print(json.dumps([{"name": s.name, "title": s.title, "summary": s.summary} for s in STUDIES.values()]))
    else:
        print("\n".join(f"{study.name:12} {study.summary}" for study in STUDIES.values()))
    return EXIT_STABLE
