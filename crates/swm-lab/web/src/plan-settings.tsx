// The settings of a planner, which are in the page's address.

import { useEffect, useState } from "preact/hooks";
import type { EnvInfo, EnvRow, Model, Planners, Solver } from "./api";
import { DecoderChoice } from "./plan-imagination";
import type { Plans } from "./plan-session";
import { type Params, patch } from "./state";
import { Choice } from "./transport";

// What the server calls the settings.
export interface Chosen {
  model: string;
  solver: string;
  settings: Record<string, unknown>;
  horizon: number;
  receding: number;
  block: number;
  score: string;
  warm: boolean;
}

const SCORES = ["terminal", "running", "reach", "success"];
// Searches of the page are smaller than the solvers' own defaults, which are those of papers: it should move at once.
const SMALL: Record<string, number> = { samples: 64, iterations: 10, elites: 8, outer_iterations: 5 };

// The settings of a solver that this page begins with.
function small(solver: Solver): Record<string, unknown> {
  const settings: Record<string, unknown> = {};
  for (const [key, value] of Object.entries(solver.defaults)) {
    if (key in SMALL && typeof value === "number") settings[key] = Math.min(value, SMALL[key]);
  }
  return settings;
}

function parseSet(text: string | undefined, solver: Solver): Record<string, unknown> {
  if (text === undefined) return small(solver);
  const settings: Record<string, unknown> = {};
  for (const pair of text.split(",").filter(Boolean)) {
    const [key, value = ""] = pair.split("=");
    if (!(key in solver.defaults)) continue;
    const number = Number(value);
    settings[key] = value === "true" ? true : value === "false" ? false : value !== "" && Number.isFinite(number) ? number : value;
  }
  return settings;
}

const formatSet = (settings: Record<string, unknown>) =>
  Object.entries(settings)
    .map(([key, value]) => `${key}=${value}`)
    .join(",");

export function chosen(planners: Planners, params: Params): { chosen: Chosen; model: Model; solver: Solver } {
  const model = planners.models.find(({ name }) => name === params.model) ?? planners.models[0];
  const first = planners.solvers.find(({ id }) => id === "cem") ?? planners.solvers[0];
  const solver = planners.solvers.find(({ id }) => id === params.solver) ?? first;
  const count = (text: string | undefined, otherwise: number) => Math.max(1, Math.floor(Number(text)) || otherwise);
  const horizon = count(params.horizon, 5);
  return {
    model,
    solver,
    chosen: {
      model: model.name,
      solver: solver?.id ?? "",
      settings: solver ? parseSet(params.set, solver) : {},
      horizon,
      receding: Math.min(count(params.receding, 2), horizon),
      block: count(params.block, 5),
      score: SCORES.includes(params.score ?? "") ? params.score : "terminal",
      warm: params.cold !== "1",
    },
  };
}

interface Props {
  rows: EnvRow[];
  info: EnvInfo;
  planners: Planners;
  params: Params;
  plans: Plans;
}

export function PlanSettings({ rows, info, planners, params, plans }: Props) {
  const { chosen: now, model, solver } = chosen(planners, params);
  const env = info.id.split(",")[0];
  const ofEnv = { pin: undefined, variation: undefined, model: undefined, solver: undefined, set: undefined };
  const set = (key: string, value: unknown) => patch({ set: formatSet({ ...now.settings, [key]: value }) });
  const counts = Object.entries(solver?.defaults ?? {}).filter(([, value]) => typeof value === "number");
  return (
    <aside class="list planner" aria-label="Planner">
      <div class="field is-wide">
        <Choice label="environment" value={env} options={rows.map(({ id }) => id)} onChange={(value) => patch({ env: value, ...ofEnv })} />
      </div>
      <div class="field is-wide">
        <Choice
          label="model"
          value={now.model}
          options={planners.models.map(({ name }) => name)}
          onChange={(value) => patch({ model: value })}
        />
      </div>
      <small>
        {model.family}
        {model.image ? `, ${model.image} px` : ""}
        {model.block ? `, ${model.block} environment steps in a model step` : ""}
      </small>
      {model.image && <DecoderChoice env={info.id} model={model} plans={plans} chosen={params.decode} />}
      <div class="field">
        <Choice
          label="solver"
          value={now.solver}
          options={planners.solvers.map(({ id }) => id)}
          onChange={(value) => patch({ solver: value, set: undefined })}
        />
      </div>
      <small>
        {solver?.summary}
        {solver && solver.needs.length > 0 ? `; needs ${solver.needs.join(", ")}` : ""}
      </small>
      <Count label="horizon" title="Model steps of a plan" value={now.horizon} onChange={(value) => patch({ horizon: value })} />
      <Count
        label="receding"
        title="Model steps that are executed before the next plan"
        value={now.receding}
        onChange={(value) => patch({ receding: value })}
      />
      {model.block === null && (
        <>
          <Count
            label="block"
            title="Environment steps in a model step"
            value={now.block}
            onChange={(value) => patch({ block: value })}
          />
          <div class="field">
            <Choice label="score" value={now.score} options={SCORES} onChange={(value) => patch({ score: value })} />
          </div>
        </>
      )}
      {counts.map(([key, value]) => (
        <Count
          key={`${solver?.id} ${key}`}
          label={key}
          title={`Default of the solver: ${value}`}
          value={Number(now.settings[key] ?? value)}
          any
          onChange={(text) => set(key, Number(text))}
        />
      ))}
      <label>
        <input
          type="checkbox"
          checked={now.warm}
          onChange={(event) => patch({ cold: event.currentTarget.checked ? undefined : "1" })}
        />
        warm start
      </label>
    </aside>
  );
}

interface CountProps {
  label: string;
  title: string;
  value: number;
  any?: boolean;
  onChange: (text: string) => void;
}

function Count({ label, title, value, any, onChange }: CountProps) {
  const [text, setText] = useState(String(value));
  useEffect(() => setText(String(value)), [value]);
  const changed = () => {
    const valid = text !== "" && Number.isFinite(Number(text)) && (any || Number(text) >= 1);
    if (valid) onChange(text);
    else setText(String(value));
  };
  return (
    <div class="field" title={title}>
      <label>
        {label}
        <input
          type="number"
          class="value"
          min={any ? undefined : 1}
          step={any ? "any" : 1}
          value={text}
          onInput={(event) => setText(event.currentTarget.value)}
          onChange={changed}
        />
      </label>
    </div>
  );
}
