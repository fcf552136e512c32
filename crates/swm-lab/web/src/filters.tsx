// Filters of the table of episodes.

import type { Dataset, Episodes, Values } from "./api";
import { count } from "./format";
import { Histogram } from "./histogram";
import { type Params, patch } from "./state";
import type { SortKey } from "./table";

const STATISTICS = ["mean", "min", "max"] as const;

// A column that episodes are filtered by, with the value of each episode.
export interface Chosen {
  name: string;
  values: (number | null)[];
}

// The column of the address, once its values have been read.
export function chosenColumn(params: Params, values: Values | undefined): Chosen | undefined {
  if (!params.col || !values) return undefined;
  const statistic = STATISTICS.find((name) => name === params.stat) ?? STATISTICS[0];
  const element = params.element === undefined ? "" : `[${params.element}]`;
  const name = isFactor(params.col) ? params.col.slice("variation.".length) : `${statistic} ${params.col}`;
  return { name: name + element, values: values[statistic] };
}

// Factors are constant over an episode.
const isFactor = (column: string) => column.startsWith("variation.");

// A range `LOW..HIGH`, each end optional.
function range(text: string | undefined): [number, number] {
  const [low, high] = (text ?? "").split("..");
  return [low ? Number(low) : -Infinity, high ? Number(high) : Infinity];
}

// The positions of the episodes that satisfy the filters, sorted.
export function order(table: Episodes, params: Params, sort: SortKey, descending: boolean, column?: Chosen): number[] {
  const lengths = range(params.lengths);
  const returns = range(params.returns);
  const ofColumn = range(params.within);
  const within = (value: number, [low, high]: [number, number]) => value >= low && value <= high;
  const rows = table.index
    .map((_, i) => i)
    .filter(
      (i) =>
        within(table.length[i], lengths) &&
        (table.returns.length === 0 || within(table.returns[i], returns)) &&
        (!column || !params.within || (column.values[i] !== null && within(column.values[i], ofColumn))) &&
        (!params.success || table.success.length === 0 || table.success[i] === (params.success === "yes")),
    );
  if (sort !== "index") {
    const values = sort === "column" ? (column?.values ?? []).map((value) => value ?? Infinity) : table[sort].map(Number);
    rows.sort((a, b) => values[a] - values[b] || a - b);
  }
  return descending ? rows.reverse() : rows;
}

interface Props {
  table: Episodes;
  set: Dataset;
  params: Params;
  shown: number;
  column?: Chosen;
}

export function Filters({ table, set, params, shown, column }: Props) {
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
        {column && (
          <Histogram
            label={column.name}
            values={column.values.filter((value) => value !== null)}
            range={params.within}
            onRange={(text) => patch({ within: text })}
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
        <ColumnChoice set={set} params={params} />
        {column && <Range label={column.name} text={params.within} onChange={(text) => patch({ within: text })} />}
      </div>
    </>
  );
}

const length = (shape: number[]) => shape.reduce((a, b) => a * b, 1);

// Chooses the column, its element, and what of its values in an episode.
function ColumnChoice({ set, params }: { set: Dataset; params: Params }) {
  const columns = (set.columns ?? []).filter((column) => !column.image && length(column.shape) <= 64 && length(column.shape) > 0);
  const elements = length(columns.find(({ name }) => name === params.col)?.shape ?? []);
  const other = { within: undefined, sort: params.sort === "column" ? undefined : params.sort };
  const choose = (name: string) => {
    const shape = columns.find((column) => column.name === name)?.shape ?? [];
    patch({ ...other, col: name, element: length(shape) > 1 ? "0" : undefined });
  };
  return (
    <>
      <label>
        column
        <select
          aria-label="Column"
          value={params.col ?? ""}
          onChange={(event) => choose(event.currentTarget.value)}
        >
          <option value="">none</option>
          {columns.map(({ name }) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </label>
      {params.col && elements > 1 && (
        <label>
          element
          <select aria-label="Element" value={params.element ?? "0"} onChange={(event) => patch({ ...other, element: event.currentTarget.value })}>
            {Array.from({ length: elements }, (_, i) => (
              <option key={i}>{i}</option>
            ))}
          </select>
        </label>
      )}
      {params.col && !isFactor(params.col) && (
        <label>
          of an episode
          <select aria-label="Statistic" value={params.stat ?? STATISTICS[0]} onChange={(event) => patch({ ...other, stat: event.currentTarget.value })}>
            {STATISTICS.map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
      )}
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
