"""Tests of the commands as functions."""

import os

import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel import cli


def written(path, value):
    with swm.data.open_writer(path) as writer:
        pixels = np.full((3, 16, 16, 3), value, np.uint8)
        writer.write_episode({"pixels": pixels, "x": np.full(3, value, np.float32)})
    return str(path)


def test_listings_print_what_the_command_prints(capfd):
    cli.envs()
    assert "swm/TwoRoom-v1" in capfd.readouterr().out
    cli.fovs("swm/TwoRoom-v1")
    assert "agent.color" in capfd.readouterr().out
    cli.main(version=True)
    assert capfd.readouterr().out.strip() == swm.__version__
    with pytest.raises(SystemExit):
        cli.fovs("swm/TwoRooom-v1")


def test_the_home_folder_is_a_folder_on_this_machine(tmp_path, monkeypatch):
    odd = os.fsdecode(b"/nowhere/n\xffu")
    monkeypatch.setenv("STABLEWM_HOME", odd)
    assert swm.utils.home() == odd
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("STABLEWM_HOME", "~/data")
    assert swm.utils.home() == str(tmp_path / "data")
    monkeypatch.setenv("STABLEWM_HOME", "s3://bucket/data")
    with pytest.raises(ValueError, match="STABLEWM_HOME.*is a URI"):
        swm.utils.home()


def test_checkpoints_are_filtered(home, capfd):
    for name in ("lewm-rooms", "pldm-rooms", "gcbc"):
        (home / "checkpoints" / name).mkdir(parents=True)
    cli.checkpoints("r[o]{2}ms$")
    assert capfd.readouterr().out.split() == ["lewm-rooms", "pldm-rooms"]


def test_datasets_are_converted_merged_and_shown(tmp_path, monkeypatch, capfd):
    one, other = written(tmp_path / "a.lance", 10), written(tmp_path / "b.h5", 20)
    cli.convert(one, str(tmp_path / "c.h5"), "hdf5")
    assert swm.data.load_dataset(tmp_path / "c.h5", backend="numpy").get_col_data("x").ravel().tolist() == [10] * 3
    cli.convert(one)
    assert swm.data.load_dataset(tmp_path / "a_video").num_episodes == 1
    cli.merge([one, other], str(tmp_path / "d.lance"))
    assert swm.data.load_dataset(tmp_path / "d.lance").num_episodes == 2
    with pytest.raises(ValueError, match="exists already"):
        cli.merge([one], str(tmp_path / "d.lance"))
    cli.merge([one], str(tmp_path / "d.lance"), overwrite=True)
    assert swm.data.load_dataset(tmp_path / "d.lance").num_episodes == 1
    monkeypatch.chdir(tmp_path)
    cli.preview(one, num=1)
    assert (tmp_path / "a_preview" / "episode_0.mp4").stat().st_size > 500
    assert "a_preview" in capfd.readouterr().out


def test_outputs_are_on_this_machine(tmp_path, monkeypatch):
    one = written(tmp_path / "a.lance", 10)
    work, user = tmp_path / "work", tmp_path / "user"
    for folder in (work, user):
        folder.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setenv("HOME", str(user))
    frames, dataset = np.zeros((2, 16, 16, 3), np.uint8), swm.data.load_dataset(one)
    study = swm.studies.run("paper/factors-per-env", "~/study")
    assert study.folder == user / "study" and swm.studies.read("~/study").is_done
    outputs = {
        "v.mp4": lambda path: swm.plot.save_video(path, frames),
        "panels": lambda path: swm.plot.save_panel_videos(path, {"a": [frames]}),
        "record": lambda path: swm.utils.record_video_from_dataset(path, dataset, 0),
        "preview": lambda path: cli.preview(one, num=1, output=path),
        "report": study.report,
        "cache": swm.data.get_cache_dir,
    }
    for name, write in outputs.items():
        for scheme in ("s3", "http"):
            with pytest.raises(ValueError, match=f"'{scheme}://bucket/{name}' is a URI; expected a path of this machine"):
                write(f"{scheme}://bucket/{name}")
        write(f"~/{name}")
        assert (user / name).exists()
    assert not list(work.iterdir())


def command(monkeypatch, *arguments):
    """Runs the command line, and returns its exit code."""
    from stable_worldmodel.__main__ import main

    monkeypatch.setattr("sys.argv", ["swm", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code


def test_the_command_takes_spellings_of_the_reference(tmp_path, monkeypatch, capfd):
    assert command(monkeypatch, "fovs", "PushT-v1") == 0 and "block.angle" in capfd.readouterr().out
    assert command(monkeypatch, "fovs", "--json", "swm/PushT-v1") == 0 and "block.angle" in capfd.readouterr().out
    assert command(monkeypatch, "fovs", "PushTT-v1") != 0 and "PushTT-v1" in capfd.readouterr().err
    one = written(tmp_path / "a.lance", 10)
    assert command(monkeypatch, "convert", one, "--dest-format", "video") == 0
    assert swm.data.load_dataset(tmp_path / "a_video").num_episodes == 1
    assert command(monkeypatch, "convert", one, str(tmp_path / "c.h5"), "-f", "hdf5") == 0
    assert command(monkeypatch, "convert", one, str(tmp_path / "d.h5"), "--format", "hdf5") == 0
    assert command(monkeypatch, "convert", one, "--dest-format=no-such-format") == 1
    assert "no-such-format" in capfd.readouterr().err
    mine = tmp_path / "mine.h5"
    mine.write_text("no dataset")
    assert command(monkeypatch, "convert", one, str(mine), "--dest-format", "hdf5") == 1
    said = capfd.readouterr().err
    assert said.startswith("error: ") and "Traceback" not in said and mine.read_text() == "no dataset"
