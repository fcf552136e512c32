// Line charts with uPlot, in the colours of the theme.

import { useEffect, useRef } from "preact/hooks";
import uPlot from "uplot";

// Colours that stay apart in both themes and for most kinds of colour blindness (Okabe and Ito).
export const COLOURS = ["#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#8a8a3a", "#7a7a7a"];

interface Props {
  title: string;
  // The x values, then the values of each series.
  data: uPlot.AlignedData;
  labels: string[];
  // The colour of each series, if not those of the list.
  colours?: string[];
  xLabel: string;
  height: number;
  isLog?: boolean;
  // Charts with the same key show one cursor.
  sync?: string;
  // The x value that is marked.
  mark?: number;
  onPick?: (index: number) => void;
}

export function Chart(props: Props) {
  const root = useRef<HTMLDivElement>(null);
  const plot = useRef<uPlot | undefined>(undefined);
  const latest = useRef(props);
  latest.current = props;
  const shape = JSON.stringify([props.labels, props.colours, props.title, props.isLog, props.height, props.sync]);

  useEffect(() => {
    const at = root.current;
    if (!at) return;
    const make = () => {
      plot.current?.destroy();
      plot.current = new uPlot(options(latest, at), latest.current.data, at);
    };
    make();
    const resized = new ResizeObserver(() => plot.current?.setSize({ width: at.clientWidth, height: props.height }));
    resized.observe(at);
    const dark = matchMedia("(prefers-color-scheme: dark)");
    dark.addEventListener("change", make);
    addEventListener("theme", make);
    return () => {
      resized.disconnect();
      dark.removeEventListener("change", make);
      removeEventListener("theme", make);
      plot.current?.destroy();
      plot.current = undefined;
    };
  }, [shape]);
  useEffect(() => plot.current?.setData(props.data), [props.data]);
  useEffect(() => plot.current?.redraw(false), [props.mark]);
  return <div class="chart" ref={root} role="img" aria-label={`Chart of ${props.title}`} />;
}

function options(props: { current: Props }, at: HTMLElement): uPlot.Options {
  const { title, labels, colours = COLOURS, xLabel, height, isLog, sync } = props.current;
  const style = getComputedStyle(at);
  const colour = (name: string) => style.getPropertyValue(name).trim();
  const axis = {
    stroke: colour("--muted"),
    grid: { stroke: colour("--line"), width: 1 },
    ticks: { stroke: colour("--line"), width: 1, size: 4 },
    font: "11px system-ui, sans-serif",
  };
  return {
    title,
    width: at.clientWidth,
    height,
    scales: { x: { time: false }, y: { distr: isLog ? 3 : 1 } },
    cursor: { sync: sync ? { key: sync } : undefined, points: { size: 6 } },
    legend: { live: true, show: labels.length <= 12 },
    series: [
      { label: xLabel },
      ...labels.map((label, i) => ({
        label,
        stroke: colours[i % colours.length],
        width: 1.5,
        points: { show: false },
        spanGaps: true,
      })),
    ],
    axes: [
      { ...axis, size: 26 },
      { ...axis, size: 52, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : compact(tick))) },
    ],
    hooks: {
      draw: [(chart) => drawMark(chart, props.current.mark, colour("--accent"))],
      ready: [
        (chart) =>
          chart.over.addEventListener("click", () => {
            const index = chart.cursor.idx;
            if (typeof index === "number") props.current.onPick?.(index);
          }),
      ],
    },
  };
}

function compact(value: number): string {
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(0);
  return String(Number(value.toPrecision(3)));
}

function drawMark(chart: uPlot, mark: number | undefined, colour: string): void {
  if (mark === undefined) return;
  const x = Math.round(chart.valToPos(mark, "x", true));
  const { ctx, bbox } = chart;
  ctx.save();
  ctx.strokeStyle = colour;
  ctx.lineWidth = devicePixelRatio;
  ctx.beginPath();
  ctx.moveTo(x, bbox.top);
  ctx.lineTo(x, bbox.top + bbox.height);
  ctx.stroke();
  ctx.restore();
}
