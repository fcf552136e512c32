// The page of datasets: the list, the table of episodes, and one episode with its frames and columns.

import { useMemo, useState } from "preact/hooks";
import { address, type Dataset, type Episodes, get, type Source, type Values } from "./api";
import { Coverage } from "./coverage";
import { Curation } from "./curation";
import { EpisodeView } from "./episode";
import { chosenColumn, Filters, order } from "./filters";
import { bytes, count } from "./format";
import { summaryOf, useSources } from "./sources";
import { type Params, patch, useKeys, useLoaded } from "./state";
import { type SortKey, Table } from "./table";

interface Listed {
  folders: string[];
  datasets: Dataset[];
  sources: Source[];
}

export function DataPage({ params }: { params: Params }) {
  const { value, error, again } = useLoaded(() => get<Listed>("datasets"), "datasets");
  const [filter, setFilter] = useState("");
  const all = [...(value?.datasets ?? []), ...useSources(value?.sources)];
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
                title={set.error ?? set.location ?? set.name}
                onClick={() =>
                  patch({ name: set.name, folder: set.folder ? String(set.folder) : undefined, episode: undefined, row: undefined, cut: undefined, col: undefined, element: undefined, within: undefined, beside: params.from ? params.beside : undefined, sort: undefined })
                }
              >
                <span>{set.name}</span>
                <small>{described(set)}</small>
              </button>
            </li>
          ))}
        </ul>
        {value && all.length === 0 && value.sources.length === 0 && (
          <p class="muted">
            No datasets in {value.folders.join(", ")}. <code>swm collect</code> writes one, and so do demonstrations that are
            recorded on the first page.
          </p>
        )}
        {error && <p class="error">{error}</p>}
      </aside>
      {chosen?.error && (
        <section class="episodes">
          <p class="error" role="alert">
            {chosen.error}
          </p>
          {/* Of a prefix that is not listed, nothing can be examined. */}
          {chosen.name !== chosen.location && (
            <Curation set={chosen} cut={new Set()} count={0} onCut={() => undefined} onSaved={again} />
          )}
        </section>
      )}
      {chosen && !chosen.error && <Opened key={`${chosen.folder}:${chosen.name}`} set={chosen} params={params} onSaved={again} />}
      {!chosen && <p class="loading">{value ? "Choose a dataset." : "Reading the folders …"}</p>}
    </div>
  );
}

function described(set: Dataset): string {
  if (set.error) return "does not open";
  if (!set.columns) return set.location ?? "";
  return `${set.env ?? "unknown environment"} · ${count(set.episodes ?? 0)} episodes · ${bytes(set.bytes ?? 0)}`;
}

interface ViewProps {
  set: Dataset;
  params: Params;
  onSaved: () => void;
}

// A dataset of a source may be chosen before the list has opened it.
function Opened({ set, params, onSaved }: ViewProps) {
  const { value, error } = useLoaded(() => (set.columns ? Promise.resolve(set) : summaryOf(set)), `${set.folder}:${set.name}`);
  const whole = set.columns ? set : value?.columns && { ...set, ...value };
  if (whole) return <DatasetView set={whole} params={params} onSaved={onSaved} />;
  return error ? (
    <p class="error" role="alert">
      {error}
    </p>
  ) : (
    <p class="loading">Opening {set.location} …</p>
  );
}

function DatasetView({ set, params, onSaved }: ViewProps) {
  const key = `${set.folder}:${set.name}`;
  const { value: table, error } = useLoaded(
    () => get<Episodes>("episodes", { folder: set.folder, name: set.name }),
    key,
  );
  const [sort, descending] = [(params.sort as SortKey) || "index", params.order === "down"];
  const ofColumn = { folder: set.folder, name: set.name, column: params.col, x: params.element ?? 0 };
  const values = useLoaded(
    () => (params.col ? get<Values>("values", ofColumn) : Promise.resolve(undefined)),
    JSON.stringify(ofColumn),
  );
  const column = useMemo(() => chosenColumn(params, values.value), [params.col, params.stat, values.value]);
  const rows = useMemo(() => (table ? order(table, params, sort, descending, column) : []), [
    table,
    column,
    params.within,
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
  const cut = useMemo(() => new Set((params.cut ?? "").split(",").filter(Boolean).map(Number)), [params.cut]);
  const setCut = (positions: Set<number>) => patch({ cut: [...positions].sort((a, b) => a - b).join(",") });
  const toggle = (position: number) => {
    const next = new Set(cut);
    if (!next.delete(position)) next.add(position);
    setCut(next);
  };
  const image = set.columns?.find((column) => column.image && column.shape.length === 3)?.name;
  const thumbnail = (position: number, row: number) =>
    address("frame", { folder: set.folder, name: set.name, episode: position, row, column: image });
  useKeys({
    ArrowDown: () => move(1),
    ArrowUp: () => move(-1),
    x: () => episode !== undefined && toggle(episode),
  });
  return (
    <>
      <section class="episodes" aria-label="Episodes">
        <h1>
          {set.name} <small>{[set.env, set.kind].filter(Boolean).join(" · ")}</small>
        </h1>
        {error && <p class="error">{error}</p>}
        {values.error && <p class="error">{values.error}</p>}
        {table ? (
          <>
            <Filters table={table} set={set} params={params} shown={rows.length} column={column} />
            {image && (
              <label>
                <input
                  type="checkbox"
                  checked={params.thumbs === "1"}
                  onChange={(event) => patch({ thumbs: event.currentTarget.checked ? "1" : undefined })}
                />
                first and last frames
              </label>
            )}
            <Table
              table={table}
              thumbnail={params.thumbs === "1" && image ? thumbnail : undefined}
              rows={rows}
              column={column}
              chosen={episode}
              cut={cut}
              onCut={toggle}
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
            <Curation set={set} cut={cut} count={table.index.length} tableKey={table.key} onCut={setCut} onSaved={onSaved} onChoose={choose} />
            <Coverage set={set} params={params} />
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
