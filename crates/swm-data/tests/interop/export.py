"""Writes `reference.lance` with the writer of the published `stable-worldmodel`. `tests/it/reference.rs` reads it.

python export.py    (stable-worldmodel of August 2026, lancedb 0.40)
"""

from pathlib import Path

import numpy as np

from reference import LanceWriter


def episode(e, last_action):
    """Returns the rows 0..6+e. Every value depends only on the episode and the row."""
    rows = range(6 + e)
    y, x = np.mgrid[:24, :32]
    return {
        "pixels": [np.stack([4 * y + 10 * e, 4 * x + t, 0 * x + 90], -1).astype(np.uint8) for t in rows],
        "action": [
            np.full(2, last_action, np.float32) if t == rows[-1] else np.array([e, t / 4], np.float32) for t in rows
        ],
        "reward": [float(t) for t in rows],
        "variation.agent.color": [np.array([e, 255, 7]) for _ in rows],
    }


here = Path(__file__).parent
path = here / "reference.lance"
with LanceWriter(path, mode="overwrite") as writer:
    writer.write_episodes(episode(e, np.nan) for e in range(2))
# When appending, lancedb rejects NaN in lists (it treats them as vectors), so the last episode ends with action 0.
with LanceWriter(path, mode="append") as writer:
    writer.write_episode(episode(2, 0.0))
with LanceWriter(here / "reference-text.lance", mode="overwrite") as writer:
    writer.write_episode({"state": [np.arange(3.0)] * 2, "task": ["push", "push"]})
