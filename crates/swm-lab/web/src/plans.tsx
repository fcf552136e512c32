// The page of plans: a solver plans in a model, step by step, and any step can be gone back to.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { type EnvInfo, type EnvRow, get, type Planners } from "./api";
import { Problems } from "./live-env";
import { Frames } from "./plan-imagination";
import { PlanChanges } from "./plan-changes";
import { nearest, SearchPanel } from "./plan-search";
import { branches, type Plans, usePlans } from "./plan-session";
import { chosen, PlanSettings } from "./plan-settings";
import { PlanFrames, PlanReadout, PlanTransport } from "./plan-stage";
import { Comparison, Tree } from "./plan-tree";
import { short } from "./format";
import { EvaluateForm } from "./start";
import { type Params, patch, useKeys, useLoaded } from "./state";

const FIRST = "swm/PushT-v1";
const SIDE = 320;
// Branches that are compared before the page chooses some.
const MOST_COMPARED = 6;
// The time that an iteration is shown when all are, in milliseconds.
const FRAME = 140;

export function PlansPage({ params }: { params: Params }) {
  const list = useLoaded(() => get<EnvRow[]>("envs"), "envs");
  const id = params.env || FIRST;
  const info = useLoaded(() => get<EnvInfo>("env", { env: id }), id);
  const planners = useLoaded(() => get<Planners>("planners", { env: id }), id);
  const error = info.error ?? planners.error;
  return (
    <div class="plans">
      {error && (
        <p class="error" role="alert">
          {error}
        </p>
      )}
      {info.value && planners.value && list.value && (
        <PlanPage key={id} rows={list.value} info={info.value} planners={planners.value} params={params} />
      )}
      {!error && !(info.value && planners.value) && <p class="loading">Loading {id} …</p>}
    </div>
  );
}

interface Props {
  rows: EnvRow[];
  info: EnvInfo;
  planners: Planners;
  params: Params;
}

function PlanPage({ rows, info, planners, params }: Props) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const plans = usePlans(info.id, SIDE, canvas);
  const { send, header, nodes, search } = plans;
  const seed = Math.max(0, Math.floor(Number(params.seed) || 0));
  const fps = Number(params.fps) || 10;
  const planner = chosen(planners, params).chosen;
  const { pin, variation } = params;
  const reset = () => send("reset", { seed, pin: pin ?? "", variation });
  useEffect(reset, [seed, pin, variation, plans.isClosed]);
  useEffect(() => send("settings", { planner }), [JSON.stringify(planner), plans.isClosed]);
  useEffect(() => send("speed", { fps }), [fps, plans.isClosed]);
  const all = useMemo(() => branches(nodes), [nodes]);
  // All branches are compared, unless the address chooses some.
  const first = all.length > 1 ? all.slice(0, MOST_COMPARED).map(({ id }) => id) : [];
  const compared = new Set(params.compare === undefined ? first : params.compare.split(",").filter(Boolean).map(Number));
  const chosenBranches = all.filter((branch) => compared.has(branch.id));
  const [iteration, setIteration] = useIteration(plans);
  const [isFanShown, setFanShown] = useState(true);
  const back = () => {
    const parent = nodes.get(header?.node ?? -1)?.parent;
    if (parent !== null && parent !== undefined) send("go", { node: parent });
  };
  const indices = search?.iterations.map(({ index }) => index) ?? [];
  const move = (by: number) => () => setIteration(indices[indices.indexOf(nearest(indices, iteration)) + by] ?? iteration);
  useKeys({
    " ": () => send("play", { on: !header?.playing }),
    ".": () => send("step"),
    ",": back,
    d: () => send("decide"),
    r: reset,
    n: () => patch({ seed: String(seed + 1) }),
    "[": move(-1),
    "]": move(1),
    c: () => void navigator.clipboard?.writeText(plans.ready?.command ?? ""),
  });
  return (
    <>
      <PlanSettings rows={rows} info={info} planners={planners} params={params} plans={plans} />
      <section class="stage" aria-label={info.id}>
        <h1>
          {info.id} <small>{info.summary}</small>
        </h1>
        <PlanFrames
          env={info.id}
          plans={plans}
          canvas={canvas}
          iteration={iteration}
          shownBranches={chosenBranches}
          isFanShown={isFanShown}
        />
        <Iterations plans={plans} iteration={iteration} onIteration={setIteration} isFanShown={isFanShown} onFan={setFanShown} />
        <PlanTransport plans={plans} seed={seed} fps={fps} onReset={reset} onBack={back} />
        <PlanReadout plans={plans} limit={info.max_episode_steps} />
        <Problems live={plans} />
        {search?.imagination?.frames && <Frames frames={search.imagination.frames} explained={plans.explained} />}
        {all.length > 0 && <Tree plans={plans} all={all} compared={compared} />}
        {chosenBranches.length > 0 && <Comparison plans={plans} chosen={chosenBranches} />}
        <PlanChanges info={info} plans={plans} />
        <div class="command" aria-label="Command">
          <code data-testid="command">{plans.ready?.command ?? ""}</code>
          <button type="button" onClick={() => void navigator.clipboard?.writeText(plans.ready?.command ?? "")}>
            Copy
          </button>
        </div>
        <EvaluateForm info={info} planner={planner} seed={seed} />
      </section>
      <SearchPanel search={search} iteration={iteration} onIteration={setIteration} />
    </>
  );
}

// The iteration that is shown: the last one of every new search.
function useIteration({ search }: Plans): [number, (index: number) => void] {
  const last = (search?.best.length ?? 1) - 1;
  const [state, setState] = useState<{ search: typeof search; index: number }>({ search, index: last });
  return [state.search === search ? Math.min(state.index, last) : last, (index) => setState({ search, index })];
}

interface IterationsProps {
  plans: Plans;
  iteration: number;
  onIteration: (index: number) => void;
  isFanShown: boolean;
  onFan: (on: boolean) => void;
}

function Iterations({ plans: { search }, iteration, onIteration, isFanShown, onFan }: IterationsProps) {
  const timer = useRef(0);
  useEffect(() => () => clearInterval(timer.current), [search]);
  const last = (search?.best.length ?? 1) - 1;
  const all = () => {
    clearInterval(timer.current);
    const indices = search?.iterations.map(({ index }) => index) ?? [];
    let at = 0;
    timer.current = setInterval(() => {
      onIteration(indices[at]);
      at += 1;
      if (at >= indices.length) clearInterval(timer.current);
    }, FRAME);
  };
  return (
    <div class="bar iterations">
      <label class="grow">
        iteration
        <input
          type="range"
          class="grow"
          min={0}
          max={Math.max(last, 0)}
          value={iteration}
          disabled={!search}
          onInput={(event) => onIteration(Number(event.currentTarget.value))}
        />
        <output>{search ? `${iteration} / ${last}, best ${short(search.best[iteration])}` : "–"}</output>
      </label>
      <button type="button" onClick={all} disabled={!search} title="Show one iteration after the other">
        Show all
      </button>
      <label title="Paths of the candidates over the frame">
        <input type="checkbox" checked={isFanShown} onChange={(event) => onFan(event.currentTarget.checked)} />
        paths
      </label>
    </div>
  );
}
