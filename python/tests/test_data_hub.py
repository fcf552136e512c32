"""Tests of datasets of a hub, on a server of this machine."""

import hashlib
import http.server
import json
import subprocess
import sys
import threading
import urllib.parse

import pytest

import stable_worldmodel as swm

COMMIT = "a" * 40


def git_id(content):
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


class Hub(http.server.BaseHTTPRequestHandler):
    """A hub with one repository, whose files are those of `folder`."""

    folder = None
    down = False

    def log_message(self, *words):
        pass

    def do_GET(self):
        if self.down:
            self.close_connection = True
            return
        path = urllib.parse.unquote(self.path.partition("?")[0])
        files = [file for file in sorted(self.folder.rglob("*")) if file.is_file()]
        names = {str(file.relative_to(self.folder.parent)): file for file in files}
        if path.startswith("/api/datasets/owner/name/revision/"):
            body = json.dumps({"id": "owner/name", "sha": COMMIT}).encode()
        elif path.startswith(f"/api/datasets/owner/name/tree/{COMMIT}"):
            listed = [
                {"type": "file", "path": name, "size": file.stat().st_size, "oid": git_id(file.read_bytes())}
                for name, file in names.items()
            ]
            body = json.dumps(listed).encode()
        else:
            body = names[path.partition(f"/resolve/{COMMIT}/")[2]].read_bytes()
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)


@pytest.fixture
def hub(tmp_path, monkeypatch):
    with swm.World("swm/TwoRoom-v1", 2, image_shape=(32, 32), max_episode_steps=8) as world:
        policy = swm.policy.RandomPolicy(0)
        world.collect(tmp_path / "rooms.lance", policy=policy, episodes=3, seed=0, progress=False)
    kind = type("OneHub", (Hub,), {"folder": tmp_path / "rooms.lance"})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), kind) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{server.server_port}")
        yield "hf://datasets/owner/name/rooms.lance"
        server.shutdown()


def test_datasets_of_a_hub_are_read_by_their_uri(hub, tmp_path):
    assert swm.data.load_dataset(hub).num_episodes == 3
    assert swm.data.load_dataset(hub.replace("hf://datasets", "lerobot:/")).num_episodes == 3
    assert len(list(swm.data.Loader(hub, batch_size=4, num_steps=2))) > 1
    assert swm.data.inspect(hub)["episodes"] == 3
    assert swm.data.convert(hub, tmp_path / "copy.h5", progress=False)["episodes"] == 3
    with swm.World("swm/TwoRoom-v1", 2, image_shape=(32, 32)) as world:
        given = {"episodes": 2, "goal_offset": 3, "eval_budget": 3, "floor": False, "progress": False}
        found = world.evaluate(policy=swm.policy.RandomPolicy(0), dataset=hub, seed=1, **given).results["manifest"]
    # Results name the commit, so that they can be compared with those of the same rows.
    assert found["config"]["dataset"] == f"hf://datasets/owner/name@{COMMIT}/rooms.lance"
    assert found["hashes"]["dataset"] == swm.data.inspect(tmp_path / "rooms.lance")["content_hash"]


def test_cached_files_that_are_read_without_a_connection_are_a_warning(hub, monkeypatch):
    swm.data.load_dataset(hub)
    monkeypatch.setattr(Hub, "down", True)
    # A process in which a command of the program has run prints the message.
    program = f"import stable_worldmodel as swm; print(swm.data.load_dataset({hub!r}).num_episodes)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "3\n"
    assert "UserWarning" in done.stderr and "downloaded before" in done.stderr
