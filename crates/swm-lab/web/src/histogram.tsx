// A histogram; a click on a bar keeps the episodes in it, another click keeps all again.

import { useMemo } from "preact/hooks";
import { short } from "./format";

const BINS = 24;
const WIDTH = 240;
const HEIGHT = 44;

interface Props {
  label: string;
  values: number[];
  range?: string;
  onRange: (range?: string) => void;
}

export function Histogram({ label, values, range, onRange }: Props) {
  const { bins, low, width } = useMemo(() => divide(values), [values]);
  const most = Math.max(1, ...bins);
  const [from, to] = (range ?? "..").split("..");
  const isIn = (i: number) =>
    (from === "" || low + (i + 1) * width > Number(from)) && (to === "" || low + i * width <= Number(to));
  return (
    <figure class="histogram">
      <svg viewBox={`0 0 ${WIDTH} ${HEIGHT}`} role="group" aria-label={`Histogram of ${label}`}>
        {bins.map((count, i) => {
          const [start, end] = [low + i * width, low + (i + 1) * width];
          const text = `${short(Number(start.toPrecision(6)))}..${short(Number(end.toPrecision(6)))}`;
          return (
            <g key={i} onClick={() => onRange(range === text ? undefined : text)} class={isIn(i) ? "" : "is-out"}>
              <title>{`${label} ${text}: ${count} episodes`}</title>
              <rect class="hit" x={(i * WIDTH) / BINS} y={0} width={WIDTH / BINS} height={HEIGHT} />
              <rect
                x={(i * WIDTH) / BINS + 0.5}
                y={HEIGHT - (count / most) * HEIGHT}
                width={WIDTH / BINS - 1}
                height={(count / most) * HEIGHT}
              />
            </g>
          );
        })}
      </svg>
      <figcaption>
        <span>{short(Number(low.toPrecision(4)))}</span>
        <b>{label}</b>
        <span>{short(Number((low + width * BINS).toPrecision(4)))}</span>
      </figcaption>
    </figure>
  );
}

function divide(values: number[]): { bins: number[]; low: number; width: number } {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    low = Math.min(low, value);
    high = Math.max(high, value);
  }
  if (!(high > low)) [low, high] = Number.isFinite(low) ? [low - 0.5, low + 0.5] : [0, 1];
  const width = (high - low) / BINS;
  const bins = new Array<number>(BINS).fill(0);
  for (const value of values) bins[Math.min(BINS - 1, Math.floor((value - low) / width))] += 1;
  return { bins, low, width };
}
