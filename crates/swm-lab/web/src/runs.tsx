// The page of runs: training curves of several runs, which follow their logs.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import uPlot from "uplot";
import { get, type Lines, type Run } from "./api";
import { Chart, COLOURS } from "./chart";
import { ago, short } from "./format";
import { type Params, patch, useLoaded } from "./state";
import { type Processes, TrainingPanel } from "./training";

interface Listed {
  folders: string[];
  runs: Run[];
}

interface Log {
  offset: number;
  lines: Record<string, number>[];
}

// How often logs and processes are read, and the list of runs, in milliseconds.
const FOLLOW = 1500;
const LIST = 3000;
// A run whose log was written in the last seconds is shown as running.
const RUNNING = 30;

const keyOf = (run: Run) => `${run.folder}:${run.name}`;

export function RunsPage({ params }: { params: Params }) {
  const { value, error, again } = useStaying(useLoaded(() => get<Listed>("runs"), "runs"));
  useInterval(again, LIST);
  const processes = useStaying(useLoaded(() => get<Processes>("processes"), "processes"));
  useInterval(processes.again, FOLLOW);
  const [filter, setFilter] = useState("");
  const runs = value?.runs ?? [];
  const chosen = (params.runs ?? "").split("|").filter(Boolean);
  const shown = runs.filter((run) => run.name.toLowerCase().includes(filter.toLowerCase()));
  const selected = runs.filter((run) => chosen.includes(keyOf(run)));
  const toggle = (run: Run) => {
    const key = keyOf(run);
    const next = chosen.includes(key) ? chosen.filter((other) => other !== key) : [...chosen, key];
    patch({ runs: next.join("|") });
  };
  const logs = useLogs(selected);
  const started = (name: string) => {
    patch({ runs: [...chosen, `0:${name}`].join("|") });
    processes.again();
    again();
  };
  return (
    <div class="runs">
      <aside class="list" aria-label="Runs">
        <input
          type="search"
          placeholder="Filter runs"
          aria-label="Filter runs"
          value={filter}
          onInput={(event) => setFilter(event.currentTarget.value)}
        />
        <ul>
          {shown.map((run) => (
            <li key={keyOf(run)}>
              <label class="run">
                <input type="checkbox" checked={chosen.includes(keyOf(run))} onChange={() => toggle(run)} />
                <span>
                  <span class="swatch-row">
                    <Swatch index={selected.indexOf(run)} />
                    {run.name}
                  </span>
                  <small>{summary(run)}</small>
                </span>
              </label>
            </li>
          ))}
        </ul>
        {value && runs.length === 0 && (
          <p class="muted">
            No runs in {value.folders.join(", ")}. <code>swm train</code> writes one; <code>swm lab --runs DIR</code> adds a
            folder.
          </p>
        )}
        {error && <p class="error">{error}</p>}
        <TrainingPanel listed={processes.value} onStarted={started} onChange={processes.again} />
      </aside>
      <section class="curves" aria-label="Training curves">
        {selected.length > 0 ? <Curves runs={selected} logs={logs} params={params} /> : <p class="loading">Choose runs.</p>}
      </section>
    </div>
  );
}

function Swatch({ index }: { index: number }) {
  if (index < 0) return null;
  return (
    <svg width="10" height="10" aria-hidden="true">
      <rect width="10" height="10" rx="2" fill={COLOURS[index % COLOURS.length]} />
    </svg>
  );
}

function summary(run: Run): string {
  const since = Date.now() / 1000 - run.modified;
  const state = since < RUNNING ? "running" : ago(since);
  const step = run.last.step === undefined ? "" : `step ${short(run.last.step)}, `;
  const loss = run.last.loss === undefined ? "" : `loss ${short(run.last.loss)}, `;
  return `${step}${loss}${state}`;
}

// Keeps the last value while another is loaded.
export function useStaying<T>(loaded: { value?: T; error?: string; again: () => void }) {
  const last = useRef(loaded.value);
  if (loaded.value !== undefined) last.current = loaded.value;
  return { ...loaded, value: last.current };
}

export function useInterval(call: () => void, milliseconds: number): void {
  const current = useRef(call);
  current.current = call;
  useEffect(() => {
    const timer = setInterval(() => !document.hidden && current.current(), milliseconds);
    return () => clearInterval(timer);
  }, [milliseconds]);
}

// The lines of the chosen runs so far.
function useLogs(runs: Run[]): Map<string, Log> {
  const [logs, setLogs] = useState(new Map<string, Log>());
  const isReading = useRef(false);
  const current = useRef(runs);
  current.current = runs;
  const known = useRef(logs);
  const read = async () => {
    if (isReading.current) return;
    isReading.current = true;
    try {
      for (const run of current.current) await follow(run);
    } finally {
      isReading.current = false;
    }
  };
  const follow = async (run: Run) => {
    for (let more = true; more; ) {
      const log = known.current.get(keyOf(run)) ?? { offset: 0, lines: [] };
      const found = await get<Lines>("lines", { folder: run.folder, name: run.name, offset: log.offset });
      if (found.offset === log.offset && found.lines.length === 0) return;
      const lines = found.offset < log.offset ? found.lines : [...log.lines, ...found.lines];
      known.current = new Map(known.current).set(keyOf(run), { offset: found.offset, lines });
      setLogs(known.current);
      more = found.more;
    }
  };
  const keys = runs.map(keyOf).join("|");
  useEffect(() => {
    void read();
  }, [keys]);
  useInterval(() => void read(), FOLLOW);
  return logs;
}

function Curves({ runs, logs, params }: { runs: Run[]; logs: Map<string, Log>; params: Params }) {
  const all = runs.map((run) => logs.get(keyOf(run))?.lines ?? []);
  const over = all.some((lines) => lines.some((line) => "step" in line)) ? "step" : "line";
  const names = useMemo(() => metrics(all, over), [logs, runs.length]);
  const chosen = (params.metrics ?? "").split(",").filter((name) => names.includes(name));
  const metricsShown = chosen.length > 0 ? chosen : names.includes("loss") ? ["loss"] : names.slice(0, 1);
  const smoothing = Number(params.smooth) || 0;
  const isLog = params.log === "1";
  const toggle = (name: string) => {
    const next = metricsShown.includes(name) ? metricsShown.filter((other) => other !== name) : [...metricsShown, name];
    patch({ metrics: next.join(",") });
  };
  return (
    <>
      <div class="bar">
        <label>
          smoothing
          <input
            type="range"
            min={0}
            max={0.99}
            step={0.01}
            value={smoothing}
            onInput={(event) => patch({ smooth: event.currentTarget.value === "0" ? undefined : event.currentTarget.value })}
          />
          <output>{smoothing}</output>
        </label>
        <label>
          <input
            type="checkbox"
            checked={isLog}
            onChange={(event) => patch({ log: event.currentTarget.checked ? "1" : undefined })}
          />
          logarithmic
        </label>
      </div>
      <div class="chips" role="group" aria-label="Metrics">
        {names.map((name) => (
          <button
            type="button"
            class="chip"
            key={name}
            aria-pressed={metricsShown.includes(name)}
            onClick={() => toggle(name)}
          >
            {name}
          </button>
        ))}
      </div>
      {metricsShown.map((name) => (
        <Chart
          key={name}
          title={name}
          data={curves(all, name, over, smoothing, isLog)}
          labels={runs.map((run) => run.name)}
          xLabel={over}
          height={metricsShown.length > 1 ? 240 : 400}
          isLog={isLog}
          sync="runs"
        />
      ))}
    </>
  );
}

function metrics(all: Record<string, number>[][], over: string): string[] {
  const names = new Set<string>();
  for (const lines of all) for (const line of lines) for (const name of Object.keys(line)) names.add(name);
  names.delete(over);
  return [...names].sort((a, b) => Number(b === "loss") - Number(a === "loss") || a.localeCompare(b));
}

function curves(
  all: Record<string, number>[][],
  metric: string,
  over: string,
  smoothing: number,
  isLog: boolean,
): uPlot.AlignedData {
  const tables = all.map((lines) => {
    const xs: number[] = [];
    const ys: (number | null)[] = [];
    let mean: number | undefined;
    lines.forEach((line, i) => {
      const value = line[metric];
      const x = line[over] ?? i;
      // A training that was resumed repeats steps; uPlot needs them in order.
      if (value === undefined || (xs.length > 0 && x <= xs[xs.length - 1])) return;
      mean = mean === undefined ? value : smoothing * mean + (1 - smoothing) * value;
      xs.push(x);
      ys.push(isLog && mean <= 0 ? null : mean);
    });
    return [xs, ys] as uPlot.AlignedData;
  });
  return uPlot.join(tables);
}
