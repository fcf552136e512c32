// The table of episodes.

import { useEffect, useRef, useState } from "preact/hooks";
import type { Episodes } from "./api";
import type { Chosen } from "./filters";
import { short } from "./format";

export type SortKey = "index" | "length" | "returns" | "success" | "column";

// The height of a row in pixels, without and with frames.
const PLAIN = 26;
const WITH_FRAMES = 64;

interface TableProps {
  table: Episodes;
  rows: number[];
  // The column that episodes are filtered by.
  column?: Chosen;
  chosen?: number;
  cut: Set<number>;
  onCut: (position: number) => void;
  sort: SortKey;
  descending: boolean;
  onChoose: (position: number) => void;
  onSort: (key: SortKey) => void;
  // The address of a frame of an episode, if frames are shown.
  thumbnail?: (position: number, row: number) => string;
}

// Only the rows in view are in the document, so that the length of the list does not matter.
export function Table({ table, rows, column, chosen, cut, onCut, sort, descending, onChoose, onSort, thumbnail }: TableProps) {
  const rowHeight = thumbnail ? WITH_FRAMES : PLAIN;
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
    if (at * rowHeight < view.scrollTop) view.scrollTop = at * rowHeight;
    else if ((at + 1) * rowHeight > view.scrollTop + view.clientHeight) view.scrollTop = (at + 1) * rowHeight - view.clientHeight;
  }, [chosen, rows, rowHeight]);
  const first = Math.max(0, Math.floor(top / rowHeight) - 5);
  const last = Math.min(rows.length, Math.ceil((top + height) / rowHeight) + 5);
  const columns: [SortKey, string, (i: number) => string][] = [
    ["index", "episode", (i) => String(table.index[i])],
    ["length", "length", (i) => String(table.length[i])],
    ["returns", "return", (i) => short(table.returns[i])],
    ["success", "success", (i) => (table.success.length === 0 ? "–" : table.success[i] ? "yes" : "no")],
  ];
  if (column) columns.push(["column", column.name, (i) => short(column.values[i])]);
  return (
    <div class={`table ${thumbnail ? "has-frames" : ""} ${column ? "has-column" : ""}`} role="table" aria-rowcount={rows.length + 1} aria-label="Episodes">
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
        <span role="columnheader" class="muted" title="Leave out of the next dataset (x)">
          cut
        </span>
      </div>
      <div class="body" ref={body} tabIndex={0} onScroll={(event) => setTop(event.currentTarget.scrollTop)} role="rowgroup">
        <div class="all" style={{ height: `${rows.length * rowHeight}px` }}>
          {rows.slice(first, last).map((position, i) => (
            <div
              role="row"
              class={`row ${position === chosen ? "is-chosen" : ""} ${cut.has(position) ? "is-cut" : ""}`}
              key={position}
              aria-rowindex={first + i + 2}
              aria-selected={position === chosen}
              style={{ transform: `translateY(${(first + i) * rowHeight}px)`, height: `${rowHeight}px` }}
              onClick={() => onChoose(position)}
            >
              {columns.map(([key, , text]) => (
                <span role="cell" key={key} class={key === "success" ? `success-${text(position)}` : ""}>
                  {text(position)}
                  {key === "index" && thumbnail && (
                    <>
                      <img src={thumbnail(position, 0)} alt={`First frame of episode ${table.index[position]}`} loading="lazy" />
                      <img
                        src={thumbnail(position, table.length[position])}
                        alt={`Last frame of episode ${table.index[position]}`}
                        loading="lazy"
                      />
                    </>
                  )}
                </span>
              ))}
              <span role="cell">
                <input
                  type="checkbox"
                  aria-label={`Cut episode ${table.index[position]}`}
                  checked={cut.has(position)}
                  onClick={(event) => event.stopPropagation()}
                  onChange={() => onCut(position)}
                />
              </span>
            </div>
          ))}
        </div>
      </div>
    </div>
  );
}
