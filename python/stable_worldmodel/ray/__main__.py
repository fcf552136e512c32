"""`python -m stable_worldmodel.ray FOLDER --trust`: continues the run in a folder. `swm COMMAND --on ray` begins one.

    python -m stable_worldmodel.ray s3://bucket/rooms.lance.ray --trust

The request in the folder is a command line of `swm`, which may load code, open connections and write files. `--trust` says that
you know who wrote it; the command that began the run continues it without. `-` reads a request from standard input. Exit codes
are those of `swm`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import Any

from . import jobs
from .driver import CellsFailed, RunRefused, execute, read_request
from .folder import Folder
from .local import connect


def main() -> int:
    """Runs the command."""
    parser = argparse.ArgumentParser(prog="python -m stable_worldmodel.ray", description=__doc__.splitlines()[0])
    parser.add_argument("run", help="the folder of a run, or - for a request on standard input")
    parser.add_argument("--job", metavar="URL", help="submit a job to the cluster with this dashboard")
    parser.add_argument("--trust", action="store_true", help="run the command line that the folder has as your own")
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    given = parser.parse_args()
    if given.run != "-" and not given.trust:
        fix = "give the command that began the run, or trust the folder (--trust) if you know who wrote it"
        print(f"error: {given.run}: its request is a command line, which a file may not choose: {fix}", file=sys.stderr)
        return 2
    try:
        request = _request(given.run)
        if given.job:
            return jobs.submit(request, given.job)
        connect()
        summary = execute(request)
    except KeyboardInterrupt:
        print("interrupted: give the same command again to continue", file=sys.stderr)
        return 130
    except (RunRefused, CellsFailed, RuntimeError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(
        json.dumps(summary) if given.json else f"{summary['output']} ({summary['cells']} cells, {summary['ran']} of them now)"
    )
    return 0


def _request(run: str) -> dict[str, Any]:
    """The request of a run."""
    if run == "-":
        return dict(json.load(sys.stdin))
    folder = Folder(run if "://" in run else os.path.abspath(run))
    found = read_request(folder)
    if found is None:
        raise RunRefused(f"{run} has no request.json: give the folder of a run")
    return found | {"folder": folder.root}


if __name__ == "__main__":
    sys.exit(main())
