// Processes that pages started, and the form of a training.

import { useState } from "preact/hooks";
import { type Dataset, get, post } from "./api";
import { useLoaded } from "./state";

interface Family {
  id: string;
  summary: string;
  presets: [string, string][];
}

export interface Process {
  kind: "training" | "collection" | "evaluation";
  name: string;
  what: string;
  state: "running" | "stopping" | "stopped" | "finished" | "failed";
  message: string;
}

export interface Processes {
  families: Family[];
  processes: Process[];
}

interface Props {
  listed?: Processes;
  // Called with the name of a run that was started, and when a list may have changed.
  onStarted: (name: string) => void;
  onChange: () => void;
}

export function TrainingPanel({ listed, onStarted, onChange }: Props) {
  const [error, setError] = useState("");
  if (!listed) return null;
  const stop = ({ kind, name }: Process) => {
    setError("");
    post("stop", { kind, name }).then(onChange, (failed) => setError(failed.message));
  };
  const isEnded = (state: string) => state === "failed" || state === "stopped";
  return (
    <section class="trainings" aria-label="Processes">
      {listed.processes.length > 0 && (
        <ul>
          {listed.processes.map((process) => (
            <li key={`${process.kind} ${process.name}`} class={`is-${process.state}`}>
              <div class="bar">
                <span title={process.what}>
                  {process.name}{" "}
                  <small>
                    {process.kind}, {process.state}
                  </small>
                </span>
                <span class="grow" />
                {process.state === "running" && (
                  <button type="button" onClick={() => stop(process)} aria-label={`Stop ${process.name}`} title="At the next safe point">
                    Stop
                  </button>
                )}
              </div>
              {process.message && (isEnded(process.state) ? <p class="error">{process.message}</p> : <small>{process.message}</small>)}
            </li>
          ))}
        </ul>
      )}
      {error && (
        <p class="error" role="alert">
          {error}
        </p>
      )}
      <details>
        <summary>Start a training</summary>
        <Form families={listed.families} onStarted={onStarted} />
      </details>
    </section>
  );
}

function Form({ families, onStarted }: { families: Family[]; onStarted: (name: string) => void }) {
  const data = useLoaded(() => get<{ datasets: Dataset[] }>("datasets"), "datasets");
  const datasets = (data.value?.datasets ?? []).filter((dataset) => !dataset.error);
  const [chosen, setChosen] = useState({ family: "", preset: "", dataset: "", name: "", steps: "300", seed: "0" });
  const [error, setError] = useState("");
  const [isSending, setSending] = useState(false);
  const family = families.find(({ id }) => id === chosen.family) ?? families[0];
  const preset = family?.presets.find(([id]) => id === chosen.preset) ?? family?.presets[0];
  const key = (dataset: Dataset) => `${dataset.folder}:${dataset.name}`;
  const dataset = datasets.find((dataset) => key(dataset) === chosen.dataset) ?? datasets[0];
  const name = chosen.name || `${family?.id.replace("_", "-")}-${dataset?.name.split(".")[0] ?? ""}`;
  const set = (change: Partial<typeof chosen>) => setChosen({ ...chosen, ...change });
  if (!family || !preset) return <p class="muted">No model can be trained.</p>;
  if (!dataset) return <p class="muted">{data.value ? "There is no dataset: record or collect one first." : "Loading datasets …"}</p>;
  const start = (event: Event) => {
    event.preventDefault();
    setSending(true);
    const wanted = { command: "train", family: family.id, preset: preset[0], folder: dataset.folder, dataset: dataset.name, name };
    post("start", { ...wanted, steps: Number(chosen.steps), seed: Number(chosen.seed) })
      .then(
        () => {
          setError("");
          onStarted(name);
        },
        (failed) => setError(failed.message),
      )
      .finally(() => setSending(false));
  };
  return (
    <form class="train" onSubmit={start}>
      <Select label="model" value={family.id} options={families.map(({ id }) => [id, id])} onChange={(value) => set({ family: value })} />
      <small>{family.summary}</small>
      <Select label="preset" value={preset[0]} options={family.presets.map(([id]) => [id, id])} onChange={(value) => set({ preset: value })} />
      <small>{preset[1]}</small>
      <Select
        label="dataset"
        value={key(dataset)}
        options={datasets.map((dataset) => [key(dataset), dataset.name])}
        onChange={(value) => set({ dataset: value })}
      />
      <label>
        steps
        <input type="number" class="value" min={1} required value={chosen.steps} onInput={(event) => set({ steps: event.currentTarget.value })} />
      </label>
      <label>
        seed
        <input type="number" class="value" min={0} required value={chosen.seed} onInput={(event) => set({ seed: event.currentTarget.value })} />
      </label>
      <label>
        name
        <input
          type="text"
          aria-label="Name of the run"
          pattern="[A-Za-z0-9_][A-Za-z0-9_\-]*"
          maxLength={64}
          value={name}
          onInput={(event) => set({ name: event.currentTarget.value })}
        />
      </label>
      {error && (
        <p class="error" role="alert">
          {error}
        </p>
      )}
      <button type="submit" class="primary" disabled={isSending}>
        Start
      </button>
    </form>
  );
}

interface SelectProps {
  label: string;
  value: string;
  options: [string, string][];
  onChange: (value: string) => void;
}

export function Select({ label, value, options, onChange }: SelectProps) {
  return (
    <label>
      {label}
      <select aria-label={label} value={value} onChange={(event) => onChange(event.currentTarget.value)}>
        {options.map(([id, text]) => (
          <option key={id} value={id}>
            {text}
          </option>
        ))}
      </select>
    </label>
  );
}
