"""Functions that find, open, convert, examine and describe datasets."""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stable_worldmodel import _engine, _files

from . import _tensors
from .dataset import Transform
from .foreign import check_distinct, check_overrides, engine_of, left_out, note_location
from .format import FORMATS, Format, check_free, detect_format, episode_lengths, get_format, is_free, open_foreign, writing
from .normalization import column_normalizer
from .writer import codec_json

__all__ = [
    "column_normalizer",
    "convert",
    "doctor",
    "ensure_dir_exists",
    "export",
    "get_cache_dir",
    "inspect",
    "load_dataset",
    "merge",
]


def get_cache_dir(override_root: str | Path | None = None, sub_folder: str | None = None) -> Path:
    """The home folder (`$STABLEWM_HOME`), or a folder in it; created if it does not exist."""
    folder = Path(_engine.home()) if override_root is None else _files.local("override_root", override_root)
    folder = folder if sub_folder is None else folder / sub_folder
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def ensure_dir_exists(path: str | Path) -> None:
    """Creates a folder if it does not exist."""
    _files.local("path", path).mkdir(parents=True, exist_ok=True)


def resolve(given: str | os.PathLike[str], cache_dir: str | os.PathLike[str] | None = None) -> str:
    """The location of an existing dataset, given by path, URI, or name under `datasets` of the home folder or `cache_dir`.

    Datasets of a hub (`hf://`, `lerobot://`) are downloaded.
    """
    text = os.fspath(given)
    if text.startswith("hf://"):
        return _engine.find_dataset(text)
    uri, text = text, text.removeprefix("lerobot://")
    if not text.strip():
        # An empty path would be the current folder; the engine says what is missing.
        return _engine.find_dataset(uri)
    if "://" in text:
        return text
    datasets = Path(_engine.home() if cache_dir is None else cache_dir).expanduser() / "datasets"
    # The dataset `OWNER/NAME` of a hub is stored as `OWNER--NAME`.
    candidates = [Path(text), datasets / text, datasets / text.replace("/", "--")]
    if cache_dir is not None:
        candidates = [*candidates[1:], *sorted(datasets.glob(f"{text}.*")), candidates[0]]
    for candidate in candidates:
        if candidate.exists():
            return os.path.abspath(candidate)
    # Of `lerobot://`, what is not on this machine is on the hub.
    return os.path.abspath(_engine.find_dataset(uri))


def load_dataset(
    name: str | os.PathLike[str],
    cache_dir: str | os.PathLike[str] | None = None,
    format: str | None = None,
    *,
    num_steps: int = 1,
    frameskip: int = 1,
    keys_to_load: list[str] | None = None,
    keys_to_cache: list[str] | None = None,
    transform: Transform | None = None,
    **kwargs: Any,
) -> Any:
    """Opens a dataset of any format, as clips for a torch `DataLoader`.

        dataset = load_dataset("pusht.lance", num_steps=4, frameskip=5, keys_to_load=["pixels", "action"])
        dataset[0]["pixels"].shape  # (4, 3, 224, 224), uint8
        dataset[0]["action"].shape  # (4, 10): the five actions of every step

    Args:
        name: A path, a URI (`s3://`, `gs://`, `az://`, `http(s)://`, `hf://`), or a name under `$STABLEWM_HOME/datasets`.
        cache_dir: A folder in place of `$STABLEWM_HOME`.
        format: The format's name; `None` detects it from the path.
        num_steps: The number of steps of a clip.
        frameskip: The number of rows from one step to the next.
        keys_to_load: The columns of a sample; all columns for `None`.
        keys_to_cache: Columns whose decoded rows stay in memory.
        transform: A function from the dict of a sample to the sample that the dataset returns.
        **kwargs: Further arguments of the format's reader; readers of native formats take `backend` (`"torch"` or `"numpy"`)
            and `keys_to_merge`.

    Returns:
        A :class:`~stable_worldmodel.data.Dataset`.
    """
    path = resolve(name, cache_dir)
    kind = get_format(format) if format is not None else detect_format(path)
    given = {
        "num_steps": num_steps,
        "frameskip": frameskip,
        "keys_to_load": keys_to_load,
        "keys_to_cache": keys_to_cache,
        "transform": transform,
    }
    if kind is None:
        _engine.check_replacement(path)
        known = ", ".join(FORMATS)
        raise ValueError(f"{path} is of no known format ({known}); name the format with format=")
    if not kind.native:
        # Readers of user-defined formats need not accept every argument.
        defaults = {"num_steps": 1, "frameskip": 1}
        given = {name: value for name, value in given.items() if value != defaults.get(name)}
    reader = kind.open_reader(path, **given, **kwargs)
    if not kind.native:
        note_location(reader, path)
    return reader


def _progress_callback(progress: bool) -> Callable[[str, int, int], None] | None:
    """A progress callback `(stage, done, total)` that shows a tqdm bar; `None` without tqdm, a terminal or a notebook."""
    notebook = "ipykernel" in sys.modules
    if not progress or not (notebook or sys.stderr.isatty()):
        return None
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return None
    bar: Any = None

    def report(stage: str, done: int, total: int) -> None:
        nonlocal bar
        if bar is None or bar.desc != stage:
            if bar is not None:
                bar.close()
            bar = tqdm(total=total, desc=stage, unit="episode")
        bar.update(done - bar.n)
        if done == total:
            bar.close()

    return report


def _options(
    format: str | None, mode: str, codec: str | None, quality: int | None, verify: bool, least_psnr: float | None
) -> str:
    if mode not in ("resume", "append", "overwrite", "error"):
        raise ValueError(f"mode: expected 'resume', 'append', 'overwrite' or 'error', got {mode!r}")
    chosen = codec_json(codec, quality, format)
    settings = {
        "format": format,
        "mode": mode,
        "codec": None if chosen is None else json.loads(chosen),
        "verify": verify,
        "least_psnr": least_psnr,
    }
    return json.dumps(settings)


def export(
    source: str | os.PathLike[str],
    file: str | os.PathLike[str] = "episodes.rrd",
    *,
    episodes: int = 4,
    columns: Sequence[str] = (),
) -> None:
    """Writes episodes for the viewer of Rerun, with the package `rerun-sdk`; `swm export` on the command line.

        export("pusht.lance", "pusht.rrd", episodes=8)

    Args:
        source: A path, a URI or a name.
        file: The file to write, which ends in `.rrd`. A recording of this package is replaced.
        episodes: The number of episodes, spread over the dataset.
        columns: The columns to write; all of them if empty.

    Raises:
        RuntimeError: If nothing was written; the reason is on standard error.
    """
    # The package is looked for in this interpreter.
    os.environ.setdefault("SWM_PYTHON", sys.executable)
    chosen = [argument for column in columns for argument in ("--column", column)]
    arguments = ["export", os.fspath(source), "--output", os.fspath(file), "--episodes", str(episodes), *chosen]
    if _engine.command(["swm", *arguments]):
        raise RuntimeError(f"{os.fspath(file)}: not written; the reason is on standard error")


def convert(
    source: Any,
    dest: str | os.PathLike[str],
    *,
    source_format: str | None = None,
    dest_format: str | None = None,
    format: str | None = None,
    cache_dir: str | os.PathLike[str] | None = None,
    progress: bool = True,
    mode: str = "resume",
    codec: str | None = None,
    jpeg_quality: int | None = None,
    verify: bool = True,
    least_psnr: float | None = None,
    **kwargs: Any,
) -> dict[str, Any]:
    """Writes a dataset in another format or codec, and compares the decoded contents.

    A conversion from or to a user-defined format leaves out texts and values of episodes, with a warning that names them. One
    to a user-defined format neither resumes nor chooses a codec, and compares the lengths of the episodes alone, if the format
    has a reader.

        convert("pusht.lance", "pusht.h5")
        convert("pusht.lance", "pusht-video", dest_format="video")

    Args:
        source: A path, a URI, a name, or an open dataset, of which all rows and columns are written as they are stored:
            `frameskip`, `keys_to_load` and `transform` concern its samples only.
        dest: The target. Its name determines the format unless `dest_format` is given; Lance otherwise.
        source_format: The source's format; `None` detects it from the path.
        dest_format: The format to write.
        format: Another name for `dest_format`.
        cache_dir: A folder in place of `$STABLEWM_HOME` that contains the source.
        progress: Whether to show a progress bar (with tqdm, if it is installed).
        mode: The treatment of an existing target: `"resume"` continues after its last episode if its content is the
            beginning of the source, `"append"` adds to it, `"overwrite"` replaces it, `"error"` raises.
        codec: The codec of images: `"qoi"` (lossless, the default), `"png"`, `"jpeg"` or `"jpeg-QUALITY"`.
        jpeg_quality: The quality of the codec `"jpeg"`, as in `codec="jpeg-QUALITY"`.
        verify: Whether to read the target and compare its content with the source.
        least_psnr: The minimum peak signal-to-noise ratio of lossy images, in dB (default: 25); a lower ratio is an error.
            Refused if no image loses anything.
        **kwargs: Further arguments of the writer of a user-defined format.

    Returns:
        A dict with `episodes`, `kept` (episodes that existed before), `rows`, `last_actions` (the number of actions left
        out, because no observation follows them), `checksum`, and the comparison of the `columns`. For a user-defined
        format, `episodes` and `rows`.

    Raises:
        TypeError: If a subclass of an open dataset that the engine reads overrides how it is read, such as `load_episode`.
        ValueError: If the target is a source, or a folder that holds one, in every mode. Of an open dataset of a class of
            your own, the location is its attribute `path`.
        RuntimeError: If the target has other contents than the source.
    """
    if isinstance(source, (str, os.PathLike)):
        source = load_dataset(source, cache_dir, source_format)
    check_overrides("convert", source, "write the episodes that it returns with open_writer")
    format = dest_format if format is None else format
    kind = get_format(format) if format is not None else detect_format(dest)
    kind = FORMATS["lance"] if kind is None else kind
    # A writer of the user may take another target than a path.
    if kind.native or isinstance(dest, (str, os.PathLike)):
        check_distinct(source, _engine.target(os.fspath(dest), kind.name) if kind.native else os.fspath(dest))
    report = _progress_callback(progress)
    if not kind.native:
        given = {"codec": codec, "jpeg_quality": jpeg_quality, "least_psnr": least_psnr}
        if refused := [name for name, value in given.items() if value is not None]:
            problem = f"the format {kind.name!r} is user-defined, and its writer decides how images are stored"
            raise ValueError(f"convert: {', '.join(refused)}: {problem}; leave it out, or give an argument of that writer")
        if mode == "resume":
            check_free(dest, f", and conversions to the user-defined format {kind.name!r} do not resume")
            mode = "error"
        before = (_lengths(kind, dest) or []) if verify and mode == "append" else []
        with left_out() as names:
            # Before the writer opens, which may replace what is there.
            engine = engine_of(source)
            written = write_all(engine, open_foreign(kind, dest, mode, **kwargs), report, names)
        _warn_left_out(dest, names)
        if verify:
            found = _lengths(kind, dest)
            _check_lengths(engine, dest, kind, None if found is None else found[len(before) :])
        return written
    if kind.name in ("video", "lance-video"):
        # Frames have no time; videos of datasets have a fixed rate.
        kwargs.pop("fps", None)
    if kwargs:
        raise TypeError(f"convert: the format {kind.name} takes no {', '.join(kwargs)}")
    options = _options(kind.name, mode, codec, jpeg_quality, verify, least_psnr)
    with left_out() as names:
        written = dict(json.loads(_engine.convert(engine_of(source), os.fspath(dest), options, report)))
    _warn_left_out(dest, names)
    return written


def _lengths(kind: type[Format], path: str | os.PathLike[str]) -> list[int] | None:
    """The lengths of the episodes of a user-defined format; `None` if the format has no reader."""
    try:
        return episode_lengths(kind.open_reader(path))
    except NotImplementedError:
        return None
    except Exception:
        # A target may be no path: the reader is asked first.
        if is_free(path):
            return []
        raise


def _check_lengths(engine: Any, dest: str | os.PathLike[str], kind: type[Format], found: list[int] | None) -> None:
    """Checks the lengths of the episodes that a writer stored against those of the source.

    Raises:
        RuntimeError: If they differ.
    """
    expected = engine.lengths().tolist()
    if found is not None and found != expected:
        given, stored = (f"{len(lengths)} episodes of {sum(lengths)} rows" for lengths in (expected, found))
        problem = f"its writer was given {given}, and stored {stored}"
        raise RuntimeError(f"{dest}: {problem}; correct the writer of the format {kind.name!r}, or use verify=False")


def _warn_left_out(dest: str | os.PathLike[str], names: set[str]) -> None:
    """Warns of the texts and values of episodes that a conversion has not written."""
    if names:
        warnings.warn(
            f"{dest}: {', '.join(sorted(names))} are left out, because a conversion from or to a user-defined "
            "format writes only columns of steps; write the episodes with open_writer to keep texts and values of episodes",
            stacklevel=3,
        )


def merge(
    sources: list[Any],
    dest: str | os.PathLike[str],
    *,
    dest_format: str | None = None,
    source_formats: list[str | None] | str | None = None,
    mode: str = "error",
    cache_dir: str | os.PathLike[str] | None = None,
    progress: bool = True,
    **dest_kwargs: Any,
) -> dict[str, Any]:
    """Writes the episodes of several datasets, one after another, into one dataset.

    Args:
        sources: Paths, URIs, names, or open datasets, whose stored rows are written, as in `convert`.
        dest: The target. Its name determines the format unless `dest_format` is given; Lance otherwise.
        dest_format: The format to write.
        source_formats: The format of all sources, or of each; `None` detects it from the path.
        mode: The treatment of an existing target; see `convert`.
        cache_dir: A folder in place of `$STABLEWM_HOME` that contains the sources.
        progress: Whether to show a progress bar.
        **dest_kwargs: Further arguments of `convert`, such as `codec`.

    Returns:
        As `convert`.
    """
    from .dataset import ConcatDataset

    if isinstance(sources, (str, os.PathLike)) or not sources:
        raise ValueError(f"sources: expected a list of datasets, got {sources!r}")
    given = [source_formats] * len(sources) if source_formats is None or isinstance(source_formats, str) else source_formats
    opened = [
        load_dataset(source, cache_dir, format) if isinstance(source, (str, os.PathLike)) else source
        for source, format in zip(sources, given, strict=True)
    ]
    return convert(ConcatDataset(opened), dest, dest_format=dest_format, mode=mode, progress=progress, **dest_kwargs)


def write_all(engine: Any, writer: Any, report: Callable[[str, int, int], None] | None, lost: set[str]) -> dict[str, Any]:
    """Writes all episodes of a dataset of the engine with a writer implemented in Python.

    Adds the names of texts and values of episodes, which the writer does not get, to `lost`.
    """
    lengths = engine.lengths()
    names = [name for name, _, _ in engine.schema() if name not in _tensors.NUMBERING]
    with writing(writer, "write_episode") as opened:
        for episode, length in enumerate(lengths):
            run = (np.asarray([value], dtype=np.int64) for value in (episode, 0, length))
            opened.write_episode(dict(engine.read(names, *run, 1)))
            lost.update(engine.constants(episode))
            if report is not None:
                report("convert", episode + 1, len(lengths))
    return {"episodes": len(lengths), "rows": int(lengths.sum())}


def doctor(
    dataset: str | os.PathLike[str],
    *,
    repair: str | os.PathLike[str] | None = None,
    format: str | None = None,
    progress: bool = True,
    codec: str | None = None,
    jpeg_quality: int | None = None,
) -> dict[str, Any]:
    """Reads a dataset as training does, and reports its problems and the models that can train on it.

    Args:
        dataset: A path, a URI or a name.
        repair: The location of a repaired copy with only the intact episodes; `None` writes no copy.
        format: The format of the copy.
        progress: Whether to show a progress bar.
        codec: The codec of images in the copy, as in :func:`convert`.
        jpeg_quality: The quality of the codec `"jpeg"`, as in `codec="jpeg-QUALITY"`.

    Returns:
        `episodes`, `rows`, `problems` (their number), `findings` (each with `severity`, `what`, `episodes`), `sound` (the
        indices of intact episodes), `models`, and `repaired` (as :func:`convert` returns it, or `None`).
    """
    options = _options(format, "resume", codec, jpeg_quality, True, None)
    target = None if repair is None else os.fspath(repair)
    return dict(json.loads(_engine.doctor(resolve(dataset), target, options, _progress_callback(progress))))


def inspect(dataset: Any, *, checksum: bool = False) -> dict[str, Any]:
    """Describes a dataset.

    Args:
        dataset: A path, a URI, a name, or an open dataset, whose stored columns are described.
        checksum: Whether to read all rows and hash the decoded content; the hash does not depend on the format.

    Returns:
        `episodes`, `steps`, `lengths`, `columns` (each with `name`, `dtype`, `shape`), `bytes`, `footprint` (bytes by
        part), `manifest`, `content_hash` and `checksum`.
    """
    if isinstance(dataset, (str, os.PathLike)):
        dataset = load_dataset(dataset)
    engine = engine_of(dataset)
    found = dict(json.loads(_engine.inspect(engine, checksum)))
    manifest = engine.manifest()
    columns = [{"name": name, "dtype": dtype, "shape": list(shape)} for name, dtype, shape in engine.schema()]
    return {**found, "columns": columns, "manifest": None if manifest is None else json.loads(manifest)}
