"""The command line of `stable_worldmodel.train`."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from .options import Options, parsed

USAGE = """Train a baseline in torch

usage: python -m stable_worldmodel.train FAMILY data=PATH [OPTION=VALUE ...]
                                         [KEY=VALUE ...]

families: lewm, pldm, dino_wm, tdmpc2, gcbc, gcivl, gciql

options:
  data=DATASET   The dataset: a path or a name
  out=RUN        The checkpoint to write (default: FAMILY-DATASET)
  preset=NAME    Size and schedule: a preset or a TOML file
  device=NAME    cpu, cuda or another device of torch (default: auto)
  amp=off        Precision of networks: off, bf16 or fp16
  compile=false  torch.compile: true, or a backend
  resume=false   Continue an interrupted training
  threads=2      Threads that load batches
  workers=0      Processes on a Ray cluster, with Ray Train

Keys are those of `swm train`, such as optim.lr=3e-4 seed=1, and
data.batch_size=auto for the largest batch that fits on a GPU. With Hydra
(pip install hydra-core), its flags work, too: --multirun, --cfg job.

example: python -m stable_worldmodel.train lewm data=rooms preset=tiny
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if sys.stdout is None:
        # Files that are opened later would take its place.
        sys.stderr.write("error: standard output is closed; redirect it to a file or to /dev/null\n")
        return 1
    return _run(given)


def _run(given: Sequence[str]) -> int:
    if not given or given[0] in ("-h", "--help", "help"):
        return _print(USAGE) or (0 if given else 2)
    family, *rest = given
    try:
        if any(argument.startswith("-") for argument in rest):
            from .sweeps import run

            run(family, rest, train)
        else:
            return train(parsed(family, rest))
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; resume=true continues\n")
        return 130
    except (ValueError, TypeError, KeyError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    except (OSError, RuntimeError, FloatingPointError, ImportError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


def _print(text: str) -> int:
    """Prints a text, and returns the exit code: 1 if it is lost, because the disk is full for example."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        sys.stderr.write(f"error: standard output: {error.strerror}; what was printed is lost\n")
        # Python would report the rest of the buffer at its end again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    return 0


def train(options: Options) -> int:
    """Trains, prints the folder of the checkpoint, and returns the exit code."""
    if options.workers:
        from ..ray.fit import fitted

        return _print(f"{fitted(options)}\n")
    from .loop import Trainer
    from .memory import explained, sized

    options = sized(options)
    with explained(options):
        trainer = Trainer(options)
        try:
            trainer.train()
        finally:
            trainer.ranks.leave()
    return _print(f"{trainer.run}\n") if trainer.ranks.rank == 0 else 0


if __name__ == "__main__":
    sys.exit(main())
