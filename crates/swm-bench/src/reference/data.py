"""Measures loading and converting of datasets by the reference implementation.

Requests, one per line: `load FORMAT PATH WORKERS STEPS FRAMESKIP BATCH SECONDS` or `convert SOURCE FORMAT PATH`.
Answers are lines that start with `SWM `: a count and seconds, or `error` and a message. Other output of the reference
is ignored.
"""

import shutil
import sys
import time
from importlib.metadata import version

import torch
from stable_worldmodel.data.format import get_format
from stable_worldmodel.data.utils import convert as convert_dataset

COLUMNS = ["pixels", "action"]


def load(name, path, workers, steps, frameskip, batch, seconds):
    format_options = {"video_keys": ["pixels"]} if name == "video" else {}
    dataset = get_format(name).open_reader(
        path, num_steps=int(steps), frameskip=int(frameskip), keys_to_load=list(COLUMNS), **format_options
    )
    loader = torch.utils.data.DataLoader(
        dataset, batch_size=int(batch), shuffle=True, drop_last=True, num_workers=int(workers)
    )

    def batches():
        while True:
            yield from loader

    endless = batches()
    # The first batch starts workers and warms caches; it is not counted.
    next(endless)
    samples = 0
    begun = time.perf_counter()
    while (elapsed := time.perf_counter() - begun) < float(seconds):
        samples += len(next(endless)["action"])
    return samples, time.perf_counter() - begun


def convert(source, name, path):
    shutil.rmtree(path, ignore_errors=True)
    begun = time.perf_counter()
    convert_dataset(source, path, dest_format=name, progress=False, mode="overwrite")
    return 1, time.perf_counter() - begun


def answer(*words):
    print("SWM", *words, flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    answer("ready", version("stable-worldmodel"))
    for line in sys.stdin:
        command, *arguments = line.rstrip("\n").split("\t")
        try:
            answer(*(load if command == "load" else convert)(*arguments))
        except Exception as error:  # The script answers with the error and continues.
            answer("error", f"{type(error).__name__}: {error}".replace("\n", " "))
