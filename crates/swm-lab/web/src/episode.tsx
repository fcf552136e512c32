// One episode: its frames, which a slider scrubs, and plots of its columns, which share the row.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type uPlot from "uplot";
import { address, type Column, type Dataset, get, type Rows } from "./api";
import { Chart } from "./chart";
import { short } from "./format";
import { summaryOf } from "./sources";
import { type Params, patch, useKeys, useLoaded } from "./state";

// Plots that are open unless the URL says otherwise.
const FIRST = ["action", "reward", "state"];
const FPS = 20;

export function EpisodeView({ set, episode, params }: { set: Dataset; episode: number; params: Params }) {
  const query = { folder: set.folder, name: set.name, episode };
  const { value, error } = useLoaded(() => get<Rows>("rows", query), JSON.stringify(query));
  const images = imagesOf(set.columns);
  const image = images.find((column) => column.name === params.column) ?? images[0];
  const other = keptBeside(set, episode, params);
  const beside = useLoaded(async () => other && (await readBeside(other, set)), JSON.stringify(other ?? null));
  const isForeign = other !== undefined && !isSame(other, set);
  const besideImages = imagesOf(beside.value?.columns);
  const besideImage = besideImages.find((column) => column.name === (params.column ?? image?.name)) ?? besideImages[0];
  const ofName = isForeign ? ` of ${other.name}` : "";
  // The longer of two episodes; the shorter one rests at its end.
  const last = Math.max(value?.rows ?? 1, beside.value?.rows.rows ?? 1) - 1;
  const within = (of?: Rows) => Math.min(row, (of?.rows ?? 1) - 1);
  const row = Math.max(0, Math.min(last, Number(params.row) || 0));
  const [isPlaying, setPlaying] = useState(false);
  const go = (to: number) => patch({ row: String(Math.max(0, Math.min(last, to))) });
  useKeys({
    ".": () => go(row + 1),
    ",": () => go(row - 1),
    " ": () => setPlaying((on) => !on),
  });
  const latest = useRef(row);
  latest.current = row;
  useEffect(() => {
    if (!isPlaying) return;
    const timer = setInterval(() => {
      if (latest.current >= last) setPlaying(false);
      else go(latest.current + 1);
    }, 1000 / FPS);
    return () => clearInterval(timer);
  }, [isPlaying, last]);
  const plotted = (rows?: Rows) => (rows?.columns ?? []).map((column) => column.name).filter((name) => !isFactor(name));
  // Columns that both datasets have.
  const common = isForeign && beside.value ? plotted(beside.value.rows) : undefined;
  const names = plotted(value).filter((name) => !common || common.includes(name));
  const given = params.plots?.split(",").filter((name) => names.includes(name));
  const shown = given ?? FIRST.filter((name) => names.includes(name));
  const toggle = (name: string) =>
    patch({ plots: (shown.includes(name) ? shown.filter((other) => other !== name) : [...shown, name]).join(",") || "none" });
  return (
    <section class="episode" aria-label={`Episode ${episode}`}>
      <div class="bar">
        <h2>
          Episode {episode} <small>{value ? `${value.rows} rows` : ""}</small>
          {other && (
            <>
              {" "}
              beside episode {other.episode}
              {ofName} <small>{beside.value ? `${beside.value.rows.rows} rows` : ""}</small>
            </>
          )}
        </h2>
        <span class="grow" />
        {image && (
          <a
            class="button"
            href={address("video", { ...query, column: image.name })}
            download={`episode_${episode}.mp4`}
            title="The video that swm preview writes"
          >
            MP4
          </a>
        )}
        <button
          type="button"
          aria-pressed={params.beside !== undefined}
          title="Keep this episode beside the next one that is chosen, also of another dataset"
          onClick={() => patch(params.beside === undefined ? { beside: String(episode), from: keyOf(set) } : { beside: undefined, from: undefined })}
        >
          {params.beside === undefined ? "Keep beside" : "Not beside"}
        </button>
      </div>
      {error && <p class="error">{error}</p>}
      {beside.error && <p class="error">{beside.error}</p>}
      {(image || besideImage) && (
        <>
          <div class="pair-of-frames">
            {image && <Frame set={set} episode={episode} row={within(value)} column={image.name} />}
            {other && beside.value && besideImage && (
              <Frame set={other} episode={other.episode} row={within(beside.value.rows)} column={besideImage.name} />
            )}
          </div>
          {images.length > 1 && (
            <div class="chips" role="group" aria-label="Column of frames">
              {images.map((column) => (
                <button
                  type="button"
                  class="chip"
                  key={column.name}
                  aria-pressed={column === image}
                  onClick={() => patch({ column: column.name })}
                >
                  {column.name}
                </button>
              ))}
            </div>
          )}
        </>
      )}
      <div class="bar">
        <button
          type="button"
          class="primary"
          aria-label={isPlaying ? "Pause" : "Play"}
          onClick={() => {
            if (!isPlaying && row >= last) go(0);
            setPlaying(!isPlaying);
          }}
        >
          {isPlaying ? "❚❚" : "▶"}
        </button>
        <input
          type="range"
          class="grow"
          min={0}
          max={last}
          value={row}
          aria-label="Row"
          onInput={(event) => go(Number(event.currentTarget.value))}
        />
        <output>
          {row} / {last}
        </output>
      </div>
      <div class="chips" role="group" aria-label="Columns">
        {names.map((name) => (
          <button type="button" class="chip" key={name} aria-pressed={shown.includes(name)} onClick={() => toggle(name)}>
            {name}
          </button>
        ))}
      </div>
      {value && <Plots rows={value} names={shown} row={row} onRow={go} />}
      {other && beside.value && (
        <>
          <h3>
            Episode {other.episode}
            {ofName}
          </h3>
          <Plots rows={beside.value.rows} names={shown} row={within(beside.value.rows)} onRow={go} />
        </>
      )}
      {value && <Factors rows={value} />}
    </section>
  );
}

type Key = Pick<Dataset, "folder" | "name">;

const keyOf = (set: Key) => `${set.folder}:${set.name}`;
const isSame = (a: Key, b: Key) => keyOf(a) === keyOf(b);

function imagesOf(columns: Column[] | undefined): Column[] {
  return (columns ?? []).filter((column) => column.image && column.shape.length === 3);
}

// The episode that is kept beside, unless it is the shown one itself. `from` has its dataset, `FOLDER:NAME`; without it, the shown one is meant.
function keptBeside(set: Dataset, episode: number, params: Params): (Key & { episode: number }) | undefined {
  if (params.beside === undefined) return undefined;
  const [, folder, name] = params.from?.match(/^(\d+):(.*)$/) ?? [];
  const kept = { folder: folder === undefined ? set.folder : Number(folder), name: name ?? set.name, episode: Number(params.beside) };
  return isSame(kept, set) && kept.episode === episode ? undefined : kept;
}

// The values of the kept episode, and the columns of its dataset.
async function readBeside(kept: Key & { episode: number }, set: Dataset) {
  const [rows, { columns }] = await Promise.all([
    get<Rows>("rows", { folder: kept.folder, name: kept.name, episode: kept.episode }),
    isSame(kept, set) ? set : summaryOf(kept),
  ]);
  return { rows, columns };
}

// Factors of variation are constant over an episode, so they are listed, not plotted.
function isFactor(name: string): boolean {
  return name.startsWith("variation.") || name.startsWith("variation_");
}

function Factors({ rows }: { rows: Rows }) {
  const factors = rows.columns.filter((column) => isFactor(column.name));
  if (factors.length === 0) return null;
  return (
    <details class="panel constants">
      <summary>
        Factors <small class="muted">{factors.length}</small>
      </summary>
      <dl>
        {factors.map(({ name, elements, values }) => (
          <div key={name}>
            <dt>{name.slice("variation.".length)}</dt>
            <dd>{values.slice(0, elements).map(short).join(", ")}</dd>
          </div>
        ))}
      </dl>
    </details>
  );
}

// Shows the frame of a row. The last frame stays until the next one has arrived, and rows that are passed in the meantime are
// left out.
function Frame({ set, episode, row, column }: { set: Key; episode: number; row: number; column: string }) {
  const [shown, setShown] = useState<string>();
  const wanted = useRef("");
  const isLoading = useRef(false);
  wanted.current = address("frame", { folder: set.folder, name: set.name, episode, row, column });
  const load = async () => {
    if (isLoading.current) return;
    isLoading.current = true;
    for (let loaded = ""; loaded !== wanted.current; ) {
      loaded = wanted.current;
      const response = await fetch(loaded).catch(() => undefined);
      if (!response?.ok) continue;
      const url = URL.createObjectURL(await response.blob());
      setShown((old) => {
        if (old) URL.revokeObjectURL(old);
        return url;
      });
    }
    isLoading.current = false;
  };
  useEffect(() => {
    void load();
  }, [wanted.current]);
  return (
    <div class="frame">
      {shown ? <img src={shown} alt={`Row ${row} of ${column}`} /> : <span class="loading">Loading …</span>}
    </div>
  );
}

function Plots({ rows, names, row, onRow }: { rows: Rows; names: string[]; row: number; onRow: (row: number) => void }) {
  const xs = useMemo(() => Array.from({ length: rows.rows }, (_, i) => i), [rows]);
  const series = useMemo(() => new Map(rows.columns.map((column) => [column.name, split(column, rows.rows)])), [rows]);
  return (
    <>
      {names.map((name) => {
        const values = series.get(name);
        if (!values) return null;
        const labels = values.map((_, i) => (values.length > 1 ? `${name}[${i}]` : name));
        return <Plot key={name} name={name} xs={xs} values={values} labels={labels} row={row} onRow={onRow} />;
      })}
    </>
  );
}

interface PlotProps {
  name: string;
  xs: number[];
  values: (number | null)[][];
  labels: string[];
  row: number;
  onRow: (row: number) => void;
}

function Plot({ name, xs, values, labels, row, onRow }: PlotProps) {
  const data = useMemo(() => [xs, ...values] as uPlot.AlignedData, [xs, values]);
  return <Chart title={name} data={data} labels={labels} xLabel="row" height={150} sync="episode" mark={row} onPick={onRow} />;
}

// Columns of a step, which the last row does not have.
const OF_STEPS = ["reward", "terminated", "truncated"];

// The values of each element, over the rows.
function split(column: Rows["columns"][number], rows: number): (number | null)[][] {
  const steps = OF_STEPS.includes(column.name) ? rows - 1 : rows;
  return Array.from({ length: column.elements }, (_, element) =>
    Array.from({ length: rows }, (_, row) => (row < steps ? column.values[row * column.elements + element] : null)),
  );
}
