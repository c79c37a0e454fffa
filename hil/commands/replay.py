"""``hil replay DIR``: repeats a run from its journal and tells whether it came out the same to the bit."""

from __future__ import annotations

import argparse
import json
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bus.frames import Frame
from hil.commands.arguments import record_directory
from hil.errors import EXIT_STABLE, EXIT_UNSTABLE, EmulationError, UserError
from hil.record import journal

if TYPE_CHECKING:
    from hil.scenario import Scenario


class Replay:
    """In the place of attached tools: what came into the run from outside comes again, at the same time."""

    def __init__(self, system: Any, entries: list[dict[str, Any]]) -> None:
        self._system = system
        self._buses = [wire.name for wire in system.wires]
        self._entries = deque(e for e in entries if e.get("by") == "query" or "frame" in e)

    def broadcast(self, *_: Any) -> None:
        """Nobody listens."""

    broadcast_error = set_state = refused = broadcast

    def poll(self) -> list[tuple[int, Frame]]:
        """Make the injections that are due; return the frames that are."""
        frames = []
        now, entries = self._system.now_ns, self._entries
        while entries and entries[0]["time_ns"] <= now:
            entry = entries.popleft()
            if "frame" in entry:
                if entry["bus"] not in self._buses:
                    raise UserError(f"the journal has a frame on a bus {entry['bus']!r}, which the robot has not")
                frames.append((self._buses.index(entry["bus"]), journal.frame_of(entry)))
            else:
                self._system.inject(entry["key"], entry["value"])
        return frames


def replay(directory: Path, out: Path | None = None, video: bool = False) -> tuple[bool, str]:
    """Whether the run recorded in ``directory`` comes out the same again, and a sentence about it.

    ``out``: where to write a whole record of the replay. ``video``: write one of the replay, into ``out`` or, without,
    beside the record, into whose report it comes. Raises UserError when there is nothing that can be replayed.
    """
    from hil.run import Request, run, versions
    from hil.scenario import from_record

    start, *entries = journal.read(directory)
    start = start["run"]
    scenario = from_record(start["configuration"], f"{directory / journal.JOURNAL_FILE}: configuration")
    recorded = {e["time_ns"]: e["digest"] for e in entries if "digest" in e and "time_ns" in e}
    end = next((e for e in entries if "end_ns" in e), None)
    if end is None:
        if not recorded:
            raise UserError(f"{directory}: the run was ended before its first digest; there is nothing to compare")
        # an event at the time of the last digest belongs to the replay, a later one was not recorded completely
        scenario = scenario.model_copy(update={"duration": (max(recorded) + 1) * 1e-9})
    digests = journal.Digests(out)

    def prepare(assembly: Any) -> None:
        assembly.system.tap = Replay(assembly.system, entries)

    request = Request(scenario, start["seed"], "inline", out=out, video=video, report=out is not None, journal=digests)
    outcome = run(request, prepare=prepare)
    if outcome.record["verdict"] == "failed":
        raise EmulationError(f"the replay did not get to its end: {outcome.record['reason']}")
    if video and out is None:
        _add_video(directory, scenario, outcome.tables)
    until = f"{max(recorded) * 1e-9:.3f} s, where the run was cut off" if end is None else "its end"
    wrong = next((time for time, digest in sorted(recorded.items()) if digests.at.get(time) != digest), None)
    if wrong is None and (end is None or outcome.record["log_digest"] == end["digest"]):
        return True, f"same digest up to {until}: {outcome.record['log_digest'] if end else recorded[max(recorded)]}"
    place = f"by {wrong * 1e-9:.3f} s" if wrong is not None else "after the last full tenth of a second"
    then, now = start.get("versions", {}), versions()
    changed = [f"{name} {then[name]} then, {now.get(name)} now" for name in then if then[name] != now.get(name)]
    return False, f"the digest differs {place}{' (' + '; '.join(changed) + ')' if changed else ''}"


def _add_video(directory: Path, scenario: Scenario, tables: dict[str, Any]) -> None:
    """Write the video of a run beside its record, and its report, if it has one, anew."""
    from hil.record.recorded import read_run
    from hil.report.html import Link
    from hil.report.page import write_report
    from hil.report.video import write_video

    write_video(directory, scenario, tables)
    found = read_run(directory)
    if found.record is not None and (directory / "report.html").exists():
        above = found.record.get("part_of")
        write_report(directory, found.record, found.tables, None if above is None else Link(**above))


def add_parser(commands: Any) -> None:
    """Add the subcommand to ``hil``."""
    parser = commands.add_parser("replay", help="repeat a recorded run, with all that came into it from outside")
    parser.add_argument("directory", type=Path, metavar="DIR", help="the run's record")
    parser.add_argument("--out", type=Path, metavar="NEW", help="write the replay's record, with logs and report")
    parser.add_argument("--video", action="store_true", help="write video.mp4, beside the record or into --out")
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.set_defaults(command=_replay)


def _replay(options: argparse.Namespace) -> int:
    if options.video:
        from hil.report.video import require_rendering

        require_rendering()
    out = None if options.out is None else record_directory(options.out)
    same, sentence = replay(options.directory, out, options.video)
    print(json.dumps({"same": same, "sentence": sentence}) if options.json else sentence)
    return EXIT_STABLE if same else EXIT_UNSTABLE
