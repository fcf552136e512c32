// Filters of the table of episodes.

import type { Episodes } from "./api";
import { count } from "./format";
import { Histogram } from "./histogram";
import { type Params, patch } from "./state";
import type { SortKey } from "./table";

// A range `LOW..HIGH`, each end optional.
function range(text: string | undefined): [number, number] {
  const [low, high] = (text ?? "").split("..");
  return [low ? Number(low) : -Infinity, high ? Number(high) : Infinity];
}

// The positions of the episodes that satisfy the filters, sorted.
export function order(table: Episodes, params: Params, sort: SortKey, descending: boolean): number[] {
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

export function Filters({ table, params, shown }: { table: Episodes; params: Params; shown: number }) {
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
