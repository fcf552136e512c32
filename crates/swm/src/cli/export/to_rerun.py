# Writes the episodes that `swm export` sends to standard input as a recording of Rerun (mod.rs describes the messages).
import json
import os
import sys

# What the package prints goes to standard error.
answers = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)
given = sys.stdin.buffer
# `swm export` prints what an error of the package means.
sys.excepthook = lambda kind, error, trace: print(f"{kind.__name__}: {error}", file=sys.stderr)


def message():
    line = given.readline()
    if not line:
        # The program that sends the episodes was killed.
        sys.exit(1)
    fields = json.loads(line)
    return fields, given.read(fields.get("bytes", 0))


opening, _ = message()
try:
    import rerun as rr
    import rerun.blueprint as rrb
    import numpy as np

    rr.EncodedImage.columns, rr.Scalars.columns, rr.escape_entity_path_part
except (ImportError, AttributeError) as error:
    print("missing:", str(error).replace("\n", " "), file=answers)
    sys.exit(1)
print("ready", file=answers)


def steps(fields):
    return [rr.TimeColumn("step", sequence=np.arange(fields["start"], fields["start"] + fields["rows"]))]


def series(path, fields, values):
    """Adds values as lines over the steps, one for each element."""
    values = values.reshape(fields["rows"], -1).astype(np.float64)
    name = fields["column"]
    names = [name] if values.shape[1] == 1 else [f"{name}[{index}]" for index in range(values.shape[1])]
    recording.log(path, rr.SeriesLines(names=names), static=True)
    recording.send_columns(path, steps(fields), columns=rr.Scalars.columns(scalars=values))


def images(path, fields, data):
    """Adds PNG files, one for each step; a single file for the whole episode."""
    ends = np.cumsum(fields["lengths"])
    files = [data[end - length : end] for end, length in zip(ends, fields["lengths"])]
    if fields["constant"]:
        recording.log(path, rr.EncodedImage(contents=files[0], media_type="image/png"), static=True)
        return
    columns = rr.EncodedImage.columns(blob=files, media_type=["image/png"] * len(files))
    recording.send_columns(path, steps(fields), columns=columns)


def planes(path, fields, values):
    """Adds depth in metres, or segments."""
    kind = rr.DepthImage if fields["kind"] == "depth" else rr.SegmentationImage
    for row in range(fields["rows"]):
        recording.set_time("step", sequence=fields["start"] + row)
        recording.log(path, kind(values[row], **({"meter": 1.0} if kind is rr.DepthImage else {})))
    recording.reset_time()


def text(episode, facts):
    rows = "".join(f"| {name} | {value} |\n" for name, value in facts)
    recording.log(f"{episode}/about", rr.TextDocument(f"| | |\n| --- | --- |\n{rows}", media_type="text/markdown"), static=True)


recording = rr.RecordingStream("stable-worldmodel", recording_id=opening["name"])
recording.save(opening["file"])
recording.send_recording_name(opening["name"])
episode, tabs, shown, columns_of = "", [], {}, {}
while True:
    fields, data = message()
    if fields["kind"] == "end":
        break
    if fields["kind"] == "episode":
        episode = fields["name"]
        text(episode, fields["facts"])
        tabs.append(episode)
        shown[episode] = {"images": [], "series": []}
        continue
    # Two names that differ in a sign of paths are two entities.
    path = f"{episode}/{rr.escape_entity_path_part(fields['column'])}"
    columns_of[path] = fields["column"]
    views = shown[episode]["series" if fields["kind"] == "values" else "images"]
    if path not in views and (fields["plotted"] or fields["kind"] != "values"):
        views.append(path)
    if fields["kind"] == "images":
        images(path, fields, data)
        continue
    values = np.frombuffer(data, dtype=fields["dtype"]).reshape(fields["rows"], *fields["shape"])
    (series if fields["kind"] == "values" else planes)(path, fields, values)

# A tab for each episode: frames and what is known about it on the left, values over the steps on the right.
layouts = []
for name in tabs:
    cameras = [rrb.Spatial2DView(origin=path, name=columns_of[path]) for path in shown[name]["images"]]
    plots = [rrb.TimeSeriesView(origin=path, name=columns_of[path]) for path in shown[name]["series"]]
    about = rrb.TextDocumentView(origin=f"{name}/about", name="about")
    left = rrb.Vertical(rrb.Grid(*cameras), about, row_shares=[2, 1]) if cameras else about
    layouts.append(rrb.Horizontal(left, rrb.Vertical(*plots), name=name) if plots else left)
recording.send_blueprint(rrb.Blueprint(rrb.Tabs(*layouts), rrb.TimePanel(timeline="step")))
recording.flush()
recording.disconnect()
print("done", file=answers)
