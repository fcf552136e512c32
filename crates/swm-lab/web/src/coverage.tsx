// The values of a column over a dataset: a histogram of each element, and a map of two of them.

import { useState } from "preact/hooks";
import { type Dataset, get } from "./api";
import { count, short } from "./format";
import { type Params, patch, useLoaded } from "./state";
import { Choice } from "./transport";

interface Element {
  low: number;
  high: number;
  mean: number;
  bins: number[];
  missing: number;
}

interface Distribution {
  rows: number;
  of: number;
  elements: Element[];
  axes: [number, number];
  map: number[][];
}

// Elements whose histograms are shown.
const MOST = 16;
const WIDTH = 120;
const HEIGHT = 36;
const CELL = 6;

export function Coverage({ set, params }: { set: Dataset; params: Params }) {
  const columns = (set.columns ?? []).filter((column) => !column.image && column.shape.reduce((a, b) => a * b, 1) <= 64);
  const names = columns.map(({ name }) => name);
  const column = names.find((name) => name === params.over) ?? (names.includes("state") ? "state" : names[0]);
  const isOpen = params.over !== undefined;
  return (
    <section class="panel coverage" aria-label="Columns">
      <div>
        <button type="button" aria-expanded={isOpen} onClick={() => patch({ over: isOpen ? undefined : column })}>
          Columns
        </button>{" "}
        <small class="muted">histograms and coverage of states, actions and others</small>
      </div>
      {isOpen && column && (
        <>
          <Choice label="column" value={column} options={names} onChange={(over) => patch({ over })} />
          <Shown key={column} set={set} column={column} />
        </>
      )}
    </section>
  );
}

function Shown({ set, column }: { set: Dataset; column: string }) {
  const [[x, y], setAxes] = useState<[number, number]>([0, 1]);
  const query = { folder: set.folder, name: set.name, column, x, y };
  const { value, error } = useLoaded(() => get<Distribution>("distribution", query), JSON.stringify(query));
  if (error) return <p class="error">{error}</p>;
  if (!value) return <p class="loading">Reading {column} …</p>;
  const axes = value.elements.map((_, i) => String(i));
  return (
    <>
      <small class="muted">
        {count(value.rows)} of {count(value.of)} rows
      </small>
      <div class="bars">
        {value.elements.slice(0, MOST).map((element, i) => (
          <Bars key={i} label={`${column}[${i}]`} element={element} />
        ))}
      </div>
      {value.elements.length > 1 && (
        <div class="bar">
          <Choice label="x" value={String(x)} options={axes} onChange={(to) => setAxes([Number(to), y])} />
          <Choice label="y" value={String(y)} options={axes} onChange={(to) => setAxes([x, Number(to)])} />
        </div>
      )}
      {value.elements.length > 1 && <CoverageMap column={column} value={value} />}
    </>
  );
}

function Bars({ label, element }: { label: string; element: Element }) {
  const most = Math.max(1, ...element.bins);
  const width = WIDTH / element.bins.length;
  return (
    <figure>
      <svg viewBox={`0 0 ${WIDTH} ${HEIGHT}`} role="img" aria-label={`Histogram of ${label}`} preserveAspectRatio="none">
        {element.bins.map((bin, i) => (
          <rect key={i} x={i * width} y={HEIGHT - (bin / most) * HEIGHT} width={width * 0.9} height={(bin / most) * HEIGHT} />
        ))}
      </svg>
      <figcaption title={`mean ${short(element.mean)}${element.missing ? `, ${element.missing} not finite` : ""}`}>
        <span>{short(element.low)}</span>
        <b>{label}</b>
        <span>{short(element.high)}</span>
      </figcaption>
    </figure>
  );
}

// How often pairs of values occur, on a logarithmic scale; cells without any stay empty.
function CoverageMap({ column, value }: { column: string; value: Distribution }) {
  const side = value.map.length;
  const most = Math.log1p(Math.max(1, ...value.map.flat()));
  const filled = value.map.flat().filter((cell) => cell > 0).length;
  const [x, y] = value.axes;
  const range = (axis: number) => `${short(value.elements[axis].low)} to ${short(value.elements[axis].high)}`;
  return (
    <figure class="map">
      <svg viewBox={`0 0 ${side * CELL} ${side * CELL}`} role="img" aria-label={`Coverage of ${column}[${x}] and ${column}[${y}]`}>
        {value.map.flatMap((row, j) =>
          row.map((cell, i) =>
            cell > 0 ? (
              <rect
                key={`${i} ${j}`}
                x={i * CELL}
                y={(side - 1 - j) * CELL}
                width={CELL}
                height={CELL}
                fill-opacity={0.15 + (0.85 * Math.log1p(cell)) / most}
              >
                <title>{`${cell} rows`}</title>
              </rect>
            ) : null,
          ),
        )}
      </svg>
      <figcaption>
        {column}[{x}], {range(x)}, to the right; {column}[{y}], {range(y)}, up; {Math.round((100 * filled) / side / side)} % of the cells have rows
      </figcaption>
    </figure>
  );
}
