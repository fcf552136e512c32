// The page of datasets: the list, the table of episodes, and one episode with its frames and columns.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { type Dataset, type Episodes, get } from "./api";
import { EpisodeView } from "./episode";
import { bytes, count, short } from "./format";
import { Histogram } from "./histogram";
import { type Params, patch, useKeys, useLoaded } from "./state";

interface Listed {
  folders: string[];
  datasets: Dataset[];
}

export function DataPage({ params }: { params: Params }) {
  const { value, error, again } = useLoaded(() => get<Listed>("datasets"), "datasets");
  const [filter, setFilter] = useState("");
  const all = value?.datasets ?? [];
  const shown = all.filter((set) => `${set.name} ${set.env ?? ""}`.toLowerCase().includes(filter.toLowerCase()));
  const folder = Number(params.folder) || 0;
  const chosen = all.find((set) => set.name === params.name && set.folder === folder);
  return (
    <div class="data">
      <aside class="list" aria-label="Datasets">
        <div class="bar">
          <input
            type="search"
            placeholder="Filter datasets"
            aria-label="Filter datasets"
            value={filter}
            onInput={(event) => setFilter(event.currentTarget.value)}
          />
          <button type="button" onClick={again} title="Read the folders again" aria-label="Reload">
            ↻
          </button>
        </div>
        <ul>
          {shown.map((set) => (
            <li key={`${set.folder}:${set.name}`}>
              <button
                type="button"
                aria-current={set === chosen}
                title={set.error ?? set.name}
                onClick={() =>
                  patch({ name: set.name, folder: set.folder ? String(set.folder) : undefined, episode: undefined, row: undefined })
                }
              >
                <span>{set.name}</span>
                <small>
                  {set.error
                    ? "does not open"
                    : `${set.env ?? "unknown environment"} · ${count(set.episodes ?? 0)} episodes · ${bytes(set.bytes ?? 0)}`}
                </small>
              </button>
            </li>
          ))}
        </ul>
        {value && all.length === 0 && (
          <p class="muted">
            No datasets in {value.folders.join(", ")}. <code>swm collect</code> writes one, and so do demonstrations that are
            recorded on the first page.
          </p>
        )}
        {error && <p class="error">{error}</p>}
      </aside>
      {chosen?.error && (
        <p class="error" role="alert">
          {chosen.error}
        </p>
      )}
      {chosen && !chosen.error && <DatasetView key={`${chosen.folder}:${chosen.name}`} set={chosen} params={params} />}
      {!chosen && <p class="loading">{value ? "Choose a dataset." : "Reading the folders …"}</p>}
    </div>
  );
}

type SortKey = "index" | "length" | "returns" | "success";

function DatasetView({ set, params }: { set: Dataset; params: Params }) {
  const key = `${set.folder}:${set.name}`;
  const { value: table, error } = useLoaded(
    () => get<Episodes>("episodes", { folder: set.folder, name: set.name }),
    key,
  );
  const [sort, descending] = [(params.sort as SortKey) || "index", params.order === "down"];
  const rows = useMemo(() => (table ? order(table, params, sort, descending) : []), [
    table,
    params.success,
    params.lengths,
    params.returns,
    sort,
    descending,
  ]);
  const episode = params.episode === undefined ? undefined : Number(params.episode);
  const choose = (position: number | undefined) =>
    patch({ episode: position === undefined ? undefined : String(position), row: undefined });
  const move = (by: number) => {
    const at = rows.indexOf(episode ?? -1);
    const next = rows[Math.min(rows.length - 1, Math.max(0, at + by))];
    if (next !== undefined) choose(next);
  };
  useKeys({ ArrowDown: () => move(1), ArrowUp: () => move(-1) });
  return (
    <>
      <section class="episodes" aria-label="Episodes">
        <h1>
          {set.name} <small>{[set.env, set.kind].filter(Boolean).join(" · ")}</small>
        </h1>
        {error && <p class="error">{error}</p>}
        {table ? (
          <>
            <Filters table={table} params={params} shown={rows.length} />
            <Table
              table={table}
              rows={rows}
              chosen={episode}
              sort={sort}
              descending={descending}
              onChoose={choose}
              onSort={(column) =>
                patch({
                  sort: column === "index" ? undefined : column,
                  order: column === sort && !descending ? "down" : undefined,
                })
              }
            />
          </>
        ) : (
          !error && <p class="loading">Reading episodes …</p>
        )}
      </section>
      {episode !== undefined && table && episode < table.index.length ? (
        <EpisodeView key={`${key}:${episode}`} set={set} episode={episode} params={params} />
      ) : (
        table && <p class="loading">Choose an episode.</p>
      )}
    </>
  );
}

// A range `LOW..HIGH`, each end optional.
function range(text: string | undefined): [number, number] {
  const [low, high] = (text ?? "").split("..");
  return [low ? Number(low) : -Infinity, high ? Number(high) : Infinity];
}

// The positions of the episodes that satisfy the filters, sorted.
function order(table: Episodes, params: Params, sort: SortKey, descending: boolean): number[] {
  const lengths = range(params.lengths);
  const returns = range(params.returns);
  const within = (value: number, [low, high]: [number, number]) => value >= low && value <= high;
  const rows = table.index
    .map((_, i) => i)
    .filter(
      (i) =>
        within(table.length[i], lengths) &&
        (table.returns.length === 0 || within(table.returns[i], returns)) &&
        (!params.success || table.success.length === 0 || table.success[i] === (params.success === "yes")),
    );
  if (sort !== "index") {
    const values = table[sort].map(Number);
    rows.sort((a, b) => values[a] - values[b] || a - b);
  }
  return descending ? rows.reverse() : rows;
}

function Filters({ table, params, shown }: { table: Episodes; params: Params; shown: number }) {
  const solved = table.success.filter(Boolean).length;
  return (
    <>
      <p class="muted" role="status">
        {count(shown)} of {count(table.index.length)} episodes
        {table.success.length > 0 && `, ${((100 * solved) / Math.max(1, table.success.length)).toFixed(1)} % solved`}
      </p>
      <div class="histograms">
        <Histogram
          label="length"
          values={table.length}
          range={params.lengths}
          onRange={(text) => patch({ lengths: text })}
        />
        {table.returns.length > 0 && (
          <Histogram
            label="return"
            values={table.returns}
            range={params.returns}
            onRange={(text) => patch({ returns: text })}
          />
        )}
      </div>
      <div class="bar">
        <label>
          success
          <select
            value={params.success ?? ""}
            disabled={table.success.length === 0}
            onChange={(event) => patch({ success: event.currentTarget.value })}
          >
            <option value="">all</option>
            <option value="yes">solved</option>
            <option value="no">not solved</option>
          </select>
        </label>
        <Range label="length" text={params.lengths} onChange={(text) => patch({ lengths: text })} />
        {table.returns.length > 0 && (
          <Range label="return" text={params.returns} onChange={(text) => patch({ returns: text })} />
        )}
      </div>
    </>
  );
}

function Range({ label, text, onChange }: { label: string; text?: string; onChange: (text?: string) => void }) {
  const [low = "", high = ""] = (text ?? "").split("..");
  const change = (ends: [string, string]) => onChange(ends.some(Boolean) ? ends.join("..") : undefined);
  const field = (name: string, value: string, changed: (value: string) => void) => (
    <input
      type="number"
      step="any"
      class="value"
      placeholder={name}
      aria-label={`${label}, ${name}`}
      value={value}
      onChange={(event) => changed(event.currentTarget.value)}
    />
  );
  return (
    <span class="range">
      {label}
      {field("min", low, (value) => change([value, high]))}
      {field("max", high, (value) => change([low, value]))}
    </span>
  );
}

const ROW = 26;

interface TableProps {
  table: Episodes;
  rows: number[];
  chosen?: number;
  sort: SortKey;
  descending: boolean;
  onChoose: (position: number) => void;
  onSort: (key: SortKey) => void;
}

// Only the rows in view are in the document, so that the length of the list does not matter.
function Table({ table, rows, chosen, sort, descending, onChoose, onSort }: TableProps) {
  const body = useRef<HTMLDivElement>(null);
  const [top, setTop] = useState(0);
  const [height, setHeight] = useState(400);
  useEffect(() => {
    const at = body.current;
    if (!at) return;
    const resized = new ResizeObserver(() => setHeight(at.clientHeight));
    resized.observe(at);
    return () => resized.disconnect();
  }, []);
  useEffect(() => {
    const at = chosen === undefined ? -1 : rows.indexOf(chosen);
    if (!body.current || at < 0) return;
    const view = body.current;
    if (at * ROW < view.scrollTop) view.scrollTop = at * ROW;
    else if ((at + 1) * ROW > view.scrollTop + view.clientHeight) view.scrollTop = (at + 1) * ROW - view.clientHeight;
  }, [chosen, rows]);
  const first = Math.max(0, Math.floor(top / ROW) - 5);
  const last = Math.min(rows.length, Math.ceil((top + height) / ROW) + 5);
  const columns: [SortKey, string, (i: number) => string][] = [
    ["index", "episode", (i) => String(table.index[i])],
    ["length", "length", (i) => String(table.length[i])],
    ["returns", "return", (i) => short(table.returns[i])],
    ["success", "success", (i) => (table.success.length === 0 ? "–" : table.success[i] ? "yes" : "no")],
  ];
  return (
    <div class="table" role="table" aria-rowcount={rows.length + 1} aria-label="Episodes">
      <div role="row" class="row head" aria-rowindex={1}>
        {columns.map(([key, name]) => (
          <span
            role="columnheader"
            key={key}
            aria-sort={sort === key ? (descending ? "descending" : "ascending") : "none"}
          >
            <button type="button" class="quiet" onClick={() => onSort(key)}>
              {name}
              {sort === key ? (descending ? " ↓" : " ↑") : ""}
            </button>
          </span>
        ))}
      </div>
      <div class="body" ref={body} tabIndex={0} onScroll={(event) => setTop(event.currentTarget.scrollTop)} role="rowgroup">
        <div class="all" style={{ height: `${rows.length * ROW}px` }}>
          {rows.slice(first, last).map((position, i) => (
            <div
              role="row"
              class={`row ${position === chosen ? "is-chosen" : ""}`}
              key={position}
              aria-rowindex={first + i + 2}
              aria-selected={position === chosen}
              style={{ transform: `translateY(${(first + i) * ROW}px)` }}
              onClick={() => onChoose(position)}
            >
              {columns.map(([key, , text]) => (
                <span role="cell" key={key} class={key === "success" ? `success-${text(position)}` : ""}>
                  {text(position)}
                </span>
              ))}
            </div>
          ))}
        </div>
      </div>
    </div>
  );
}
