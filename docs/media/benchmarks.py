"""Measures this engine beside the reference and its neighbours, and draws `benchmarks.svg`, the plot of the README.

    python docs/media/benchmarks.py measure --reference PYTHON    # on an idle machine; `make bench-plot` does both
    python docs/media/benchmarks.py draw

`benchmarks.json` holds a row for each bar: how many times as fast this engine is, the command that says so, the machine and the date. `measure`
replaces the rows whose commands run here, and keeps the others. `PYTHON` has the reference implementation (`make reference`); the Python that runs
this script has the wheel, PyTorch, Gymnasium and Stable-Baselines3.
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
from datetime import date
from html import escape
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
DATA, PLOT = HERE / "benchmarks.json", HERE / "benchmarks.svg"

WIDTH, LABELS, RIGHT, ROW, TOP = 860, 400, 64, 23, 84
LOW, HIGH, TICKS = 0.04, 30.0, (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20)
#: The colours of a light and of a dark page.
STYLE = """
  text { font: 13px system-ui, -apple-system, "Segoe UI", Helvetica, Arial, sans-serif; fill: #1f2328 }
  .title { font-size: 16px; font-weight: 600 } .group { font-weight: 600 } .quiet { fill: #59636e } .small { font-size: 11.5px }
  .card { fill: #ffffff; stroke: #d1d9e0 } .grid { stroke: #e4e8ec } .one { stroke: #59636e } .faster { fill: #1f6feb } .slower { fill: #d4791f }
  @media (prefers-color-scheme: dark) {
    text { fill: #e6edf3 } .quiet { fill: #9198a1 } .card { fill: #0d1117; stroke: #3d444d } .grid { stroke: #21262d } .one { stroke: #9198a1 }
    .faster { fill: #4493f8 } .slower { fill: #db8a3a }
  }
"""


def of_model(text, work):
    """The ratio of a workload in the output of `swm bench plan`, `train` or `online`."""
    found = json.loads(text)
    found = found.get("models", found) if isinstance(found, dict) else found
    report = found[0] if isinstance(found, list) else found
    share = next(row["share"] for row in report["rows"] if row["work"] == work)
    return 1 / share


def of_loader(text, layout):
    """The ratio of our loader without a cache in the output of `bench_loader.py`."""
    line = next(line for line in text.splitlines() if line.startswith(layout) and "every frame decoded" in line)
    return float(line.split()[-1].rstrip("x"))


def of_gym(text, name):
    """The ratio of an environment in the output of `bench_gym.py`."""
    return float(re.search(rf"^{re.escape(name)}, 8 environments: ([0-9.]+) x$", text, re.MULTILINE)[1])


#: How the output of a row's command gives its ratio.
READERS = {
    "hdf5": lambda text: of_loader(text, "hdf5"),
    "lossless": lambda text: of_loader(text, "lance, lossless"),
    "jpeg": lambda text: of_loader(text, "lance, jpeg"),
    "plan": lambda text: of_model(text, "plan"),
    "train-paper": lambda text: of_model(text, "train"),
    "train-small": lambda text: of_model(text, "train"),
    "sac": lambda text: of_model(text, "train"),
    "tdmpc2": lambda text: of_model(text, "train"),
    "cartpole": lambda text: of_gym(text, "CartPole-v1"),
    "pong": lambda text: of_gym(text, "ALE/Pong-v5"),
}


def processor():
    """The number of the processor's threads and its name."""
    names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return f"{os.cpu_count()} threads of {names[0].strip() if names else 'an unknown processor'}"


def measure(rows, swm, reference):
    """Replaces the rows whose commands run here."""
    outputs = {}
    environment = {**os.environ, "SWM_REFERENCE_PYTHON": reference}
    for row in rows:
        if row["id"] not in READERS:
            continue
        command = row["command"]
        if command not in outputs:
            words = command.split()
            start = [swm, *words[1:], "--json"] if words[0] == "swm" else [sys.executable, *words[1:]]
            start += ["--reference", reference] if "bench_loader" in command else []
            print(command, file=sys.stderr)
            done = subprocess.run(start, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
            outputs[command] = done.stdout if done.returncode == 0 else None
        try:
            ratio = READERS[row["id"]](outputs[command] or "")
        except (ValueError, TypeError, KeyError, StopIteration) as error:
            print(f"{row['label']}: not measured, the old value stays ({error!r})", file=sys.stderr)
            continue
        row.update(ratio=round(ratio, 2), machine=f"CPU: {processor()}", date=date.today().isoformat())


def position(ratio):
    """The horizontal position of a ratio on the logarithmic axis."""
    share = (math.log(ratio) - math.log(LOW)) / (math.log(HIGH) - math.log(LOW))
    return LABELS + share * (WIDTH - LABELS - RIGHT)


def shown(ratio):
    """A ratio as text: 19, 10.5, 0.05."""
    return f"{round(ratio, 1):g}" if ratio >= 1 else f"{round(ratio, 2):g}"


def days(first, last):
    """The days from the first to the last, such as `21 to 26 November 2026`."""
    first, last = date.fromisoformat(first), date.fromisoformat(last)
    if first == last:
        return f"{last:%-d %B %Y}"
    start = f"{first:%-d}" if (first.year, first.month) == (last.year, last.month) else f"{first:%-d %B %Y}"
    return f"{start} to {last:%-d %B %Y}"


def machines(rows):
    """A line for each machine: its name and the dates of its rows."""
    names = dict.fromkeys(row["machine"] for row in rows)
    for name in names:
        dates = sorted(row["date"] for row in rows if row["machine"] == name)
        yield f"{name}: {days(dates[0], dates[-1])}"


def draw(rows):
    """Returns the plot as SVG."""
    groups = dict.fromkeys(row["group"] for row in rows)
    notes = ["Medians of alternating measurements. The reference is the package stable-worldmodel of PyPI. Commands: docs/media/benchmarks.json"]
    foot = [*machines(rows), *notes]
    bottom = TOP + ROW * (len(rows) + len(groups)) + 10
    height = bottom + 34 + 17 * len(foot)
    one = position(1)
    parts = [
        f'<rect class="card" x="0.5" y="0.5" width="{WIDTH - 1}" height="{height - 1}" rx="8"/>',
        '<text class="title" x="20" y="32">Speed beside the reference and its neighbours</text>',
        '<text class="quiet" x="20" y="52">How many times as fast this engine is; to the right of 1 it is faster (logarithmic scale)</text>',
    ]
    for tick in TICKS:
        x = position(tick)
        kind = "one" if tick == 1 else "grid"
        parts.append(f'<line class="{kind}" x1="{x:.1f}" y1="{TOP - 8}" x2="{x:.1f}" y2="{bottom}"/>')
        parts.append(f'<text class="quiet small" x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{tick:g} ×</text>')
    y = TOP
    for group in groups:
        parts.append(f'<text class="group" x="20" y="{y + 12}">{escape(group)}</text>')
        y += ROW
        for row in (row for row in rows if row["group"] == group):
            ratio, x = row["ratio"], position(row["ratio"])
            faster = ratio >= 1
            against = f'<tspan class="quiet small"> beside {escape(row["against"])}</tspan>'
            parts.append(f'<text x="{LABELS - 14}" y="{y + 12}" text-anchor="end">{escape(row["label"])}{against}</text>')
            width = max(abs(x - one), 1)
            kind = "faster" if faster else "slower"
            parts.append(f'<rect class="{kind}" x="{min(x, one):.1f}" y="{y}" width="{width:.1f}" height="{ROW - 8}" rx="2"/>')
            parts.append(f'<text x="{max(x, one) + 6:.1f}" y="{y + 12}">{shown(ratio)} ×</text>')
            y += ROW
    for index, line in enumerate(foot):
        parts.append(f'<text class="quiet small" x="20" y="{bottom + 42 + 17 * index}">{escape(line)}</text>')
    body = "\n  ".join(parts)
    label = "Speed of this engine divided by that of other implementations: " + "; ".join(
        f"{row['label']} beside {row['against']} {shown(row['ratio'])}" for row in rows
    )
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" role="img"'
    return f'{head} aria-label="{escape(label)}">\n  <style>{STYLE}  </style>\n  {body}\n</svg>\n'


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("step", choices=["measure", "draw"])
    parser.add_argument("--reference", help="a Python with the reference implementation")
    parser.add_argument("--swm", default="swm", help="the program")
    given = parser.parse_args()
    rows = json.loads(DATA.read_text())
    if given.step == "measure":
        if given.reference is None:
            parser.error("measure needs --reference PYTHON, made by `make reference`")
        measure(rows, given.swm, given.reference)
        DATA.write_text(json.dumps(rows, indent=2, ensure_ascii=False) + "\n")
    PLOT.write_text(draw(rows))


if __name__ == "__main__":
    main()
