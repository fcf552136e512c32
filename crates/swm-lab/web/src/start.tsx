// Forms that start a collection or an evaluation.

import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import { type Dataset, type EnvInfo, get, post } from "./api";
import type { Chosen } from "./plan-settings";
import { type Params, useLoaded } from "./state";
import { Select } from "./training";

interface FormProps {
  summary: string;
  // The body of the request, without the name.
  body: Record<string, unknown>;
  name: string;
  onName: (name: string) => void;
  children: ComponentChildren;
}

function StartForm({ summary, body, name, onName, children }: FormProps) {
  const [error, setError] = useState("");
  const [started, setStarted] = useState("");
  const start = (event: Event) => {
    event.preventDefault();
    setStarted("");
    post("start", { ...body, name }).then(
      () => (setError(""), setStarted(name)),
      (failed) => setError(failed.message),
    );
  };
  return (
    <details class="starting">
      <summary>{summary}</summary>
      <form class="train" onSubmit={start}>
        {children}
        <label>
          name
          <input
            type="text"
            aria-label="Name of what is written"
            pattern="[A-Za-z0-9_][A-Za-z0-9_\-]*"
            maxLength={64}
            required
            value={name}
            onInput={(event) => onName(event.currentTarget.value)}
          />
        </label>
        {error && (
          <p class="error" role="alert">
            {error}
          </p>
        )}
        <button type="submit" class="primary">
          Start
        </button>
        {started && (
          <small>
            {started} was started: <a href="#runs">Runs</a> shows how far it is.
          </small>
        )}
      </form>
    </details>
  );
}

interface NumberProps {
  label: string;
  value: string;
  min: number;
  onInput: (value: string) => void;
}

function NumberField({ label, value, min, onInput }: NumberProps) {
  return (
    <label>
      {label}
      <input type="number" class="value" min={min} required value={value} onInput={(event) => onInput(event.currentTarget.value)} />
    </label>
  );
}

const plain = (env: string) => env.split(",")[0].replace(/^swm\//, "").replace(/-v\d+$/, "").toLowerCase().replace(/[^a-z0-9]/g, "-");

// Episodes of the environment as the page shows it: its factors and its seed.
export function CollectForm({ info, params }: { info: EnvInfo; params: Params }) {
  const policies = [...info.experts.map(({ id }) => id), "random"];
  const [chosen, setChosen] = useState({ policy: "", episodes: "100", image: "64", name: "" });
  const set = (change: Partial<typeof chosen>) => setChosen({ ...chosen, ...change });
  const policy = policies.includes(chosen.policy) ? chosen.policy : policies[0];
  const { pin, variation } = params;
  const body = {
    command: "collect",
    env: info.id,
    policy,
    episodes: Number(chosen.episodes),
    image: Number(chosen.image),
    seed: Math.max(0, Math.floor(Number(params.seed) || 0)),
    pin: pin ?? "",
    variation: variation ?? null,
  };
  return (
    <StartForm
      summary="Collect episodes"
      body={body}
      name={chosen.name || `${plain(info.id)}-${policy}`}
      onName={(name) => set({ name })}
    >
      <Select label="policy" value={policy} options={policies.map((id) => [id, id])} onChange={(value) => set({ policy: value })} />
      <NumberField label="episodes" min={1} value={chosen.episodes} onInput={(value) => set({ episodes: value })} />
      <NumberField label="frame size" min={16} value={chosen.image} onInput={(value) => set({ image: value })} />
    </StartForm>
  );
}

const NO_DATASET = "episodes of the environment";

interface EvaluateProps {
  info: EnvInfo;
  planner: Chosen;
  seed: number;
}

// Episodes that the planner of the page plays.
export function EvaluateForm({ info, planner, seed }: EvaluateProps) {
  const [chosen, setChosen] = useState({ dataset: "", episodes: "20", name: "" });
  const set = (change: Partial<typeof chosen>) => setChosen({ ...chosen, ...change });
  const listed = useLoaded(() => get<{ datasets: Dataset[] }>("datasets"), "datasets");
  const base = info.id.split(",")[0];
  const datasets = (listed.value?.datasets ?? []).filter((dataset) => dataset.env?.split(",")[0] === base);
  const key = ({ folder, name }: Dataset) => `${folder}/${name}`;
  const dataset = datasets.find((dataset) => key(dataset) === chosen.dataset);
  const body = {
    command: "evaluate",
    env: info.id,
    planner,
    dataset: dataset ? { folder: dataset.folder, name: dataset.name } : null,
    episodes: Number(chosen.episodes),
    seed,
  };
  const name = chosen.name || `${plain(info.id)}-${planner.model.split("/").pop()?.replace(/[^A-Za-z0-9_-]/g, "-")}`;
  return (
    <StartForm summary="Evaluate this planner" body={body} name={name} onName={(name) => set({ name })}>
      <Select
        label="starts"
        value={chosen.dataset}
        options={[["", NO_DATASET], ...datasets.map((dataset): [string, string] => [key(dataset), `states of ${dataset.name}`])]}
        onChange={(value) => set({ dataset: value })}
      />
      <NumberField label="episodes" min={1} value={chosen.episodes} onInput={(value) => set({ episodes: value })} />
    </StartForm>
  );
}
