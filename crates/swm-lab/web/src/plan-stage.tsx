// The frame that is planned from, the paths of candidates over it, the goal, and the controls of the episode.

import { type RefObject } from "preact";
import { COLOURS } from "./chart";
import { short } from "./format";
import { nearest } from "./plan-search";
import { type Branch, type Path, type Plans, pathTo, type Search } from "./plan-session";
import { patch } from "./state";
import { Choice } from "./transport";
import { Values } from "./values";

const SPEEDS = [1, 2, 5, 10, 20, 30, 60];
// Sides of the drawing.
const SIDE = 1000;

const points = (line: [number, number][]) => line.map(([x, y]) => `${SIDE * x},${SIDE * y}`).join(" ");

// The paths of the candidates of an iteration, the cheapest on top.
export function Fan({ search, iteration, children }: { search?: Search; iteration: number; children?: preact.ComponentChildren }) {
  const of = search && search.paths.length > 0 ? nearest(search.paths.map((path) => path.iteration), iteration) : -1;
  const paths = (search?.paths ?? []).filter((path) => path.iteration === of);
  const kind = (path: Path) => (path.rank === null ? "is-other" : path.rank === 0 ? "is-best" : "is-elite");
  return (
    <svg class="fan" viewBox={`0 0 ${SIDE} ${SIDE}`} aria-hidden="true">
      {children}
      {[...paths].reverse().map((path, i) =>
        path.lines.map((line, which) => (
          <g key={`${i} ${which}`} class={`${kind(path)} line-${which}`}>
            <polyline class="halo" points={points(line)} />
            <polyline points={points(line)} />
            {path.rank !== null && <circle cx={SIDE * line[line.length - 1][0]} cy={SIDE * line[line.length - 1][1]} r={path.rank === 0 ? 11 : 7} />}
          </g>
        )),
      )}
    </svg>
  );
}

interface StageProps {
  env: string;
  plans: Plans;
  canvas: RefObject<HTMLCanvasElement | null>;
  iteration: number;
  shownBranches: Branch[];
  isFanShown: boolean;
}

export function PlanFrames({ env, plans, canvas, iteration, shownBranches, isFanShown }: StageProps) {
  const { header, nodes, search, searchAt } = plans;
  const outcome = header?.success ? "goal reached" : header?.ended ? "ended" : undefined;
  const played = pathTo(nodes, header?.node);
  const lines = played[0]?.at.map((_, which) => played.map((node) => node.at[which])) ?? [];
  const others = shownBranches.filter((branch) => branch.id !== nodes.get(header?.node ?? -1)?.branch);
  // The candidates of a search start where it was made.
  const isHere = isFanShown && searchAt !== undefined && played.slice(-30).some(({ id }) => id === searchAt);
  return (
    <div class="frames">
      <div class="frame">
        <canvas ref={canvas} role="img" aria-label={`Frame of ${env} at step ${header?.step ?? 0}`} />
        <Fan search={isHere && search?.explained === null ? search : undefined} iteration={iteration}>
          {others.map((branch) => {
            const path = pathTo(nodes, branch.tip.id).slice(-branch.nodes.length - 1);
            return path[0]?.at.map((_, which) => (
              <polyline
                key={`${branch.id} ${which}`}
                class="branch"
                stroke={COLOURS[branch.id % COLOURS.length]}
                points={points(path.map((node) => node.at[which]))}
              />
            ));
          })}
          {lines.map((line, which) => (
            <polyline key={which} class="played" points={points(line)} />
          ))}
        </Fan>
        {outcome && <div class={`ended ${header?.success ? "is-success" : ""}`}>{outcome}</div>}
        {header?.searching && (
          <div class="ended" role="status">
            searching{plans.searching ? `: iteration ${plans.searching.iteration}, best ${short(plans.searching.best)}` : " …"}
          </div>
        )}
      </div>
      {plans.goal && (
        <figure class="frame versus">
          <img src={plans.goal} alt={`Goal of ${env}`} />
          <span class="ended">goal</span>
        </figure>
      )}
    </div>
  );
}

interface TransportProps {
  plans: Plans;
  seed: number;
  fps: number;
  onReset: () => void;
  onBack: () => void;
}

export function PlanTransport({ plans, seed, fps, onReset, onBack }: TransportProps) {
  const { header, send } = plans;
  const isPlaying = Boolean(header?.playing);
  const isBusy = Boolean(header?.searching);
  return (
    <div class="bar transport" role="toolbar" aria-label="Playback">
      <button
        type="button"
        class="primary"
        onClick={() => send("play", { on: !isPlaying })}
        disabled={header?.ended}
        aria-label={isPlaying ? "Pause" : "Play"}
        title="Space"
      >
        {isPlaying ? "❚❚" : "▶"}
      </button>
      {isBusy ? (
        <button type="button" onClick={() => send("enough")} title="End the search with the best plan so far">
          Enough
        </button>
      ) : (
        <button
          type="button"
          onClick={() => send("decide")}
          disabled={header?.ended}
          title="Execute the plan, and search the next one (d)"
        >
          Decide
        </button>
      )}
      <button type="button" onClick={() => send("step")} disabled={header?.ended} aria-label="Step" title="One step (.)">
        ▸|
      </button>
      <button type="button" onClick={onBack} aria-label="Back" title="Back one step (,)">
        |◂
      </button>
      <button type="button" onClick={onReset} title="Reset with the same seed (r)">
        Reset
      </button>
      <label>
        seed
        <input
          type="number"
          class="value"
          min={0}
          value={seed}
          onChange={(event) => patch({ seed: String(Math.max(0, Math.floor(Number(event.currentTarget.value) || 0))) })}
        />
      </label>
      <button type="button" onClick={() => patch({ seed: String(seed + 1) })} title="Reset with the next seed (n)">
        Next
      </button>
      <span class="grow" />
      <Choice label="steps/s" value={String(fps)} options={SPEEDS.map(String)} onChange={(value) => patch({ fps: value })} />
    </div>
  );
}

export function PlanReadout({ plans, limit }: { plans: Plans; limit: number }) {
  const { header } = plans;
  const values: [string, string][] = [
    ["step", `${header?.step ?? 0} / ${limit}`],
    ["return", short(header?.total)],
    ["distance", short(header?.distance)],
    ["goal", header?.success ? "reached" : "not reached"],
    ["left of the plan", `${header?.left ?? 0} steps`],
  ];
  return <Values values={values} success={header?.success} state={header?.state} />;
}
