// What a world model imagines of the cheapest candidates, beside what they lead to.

import { useEffect, useMemo } from "preact/hooks";
import type uPlot from "uplot";
import { Chart, COLOURS } from "./chart";
import { type Dataset, get, type Model } from "./api";
import { short } from "./format";
import type { Decoded, Imagination, Plans } from "./plan-session";
import { patch, useLoaded } from "./state";
import { Choice } from "./transport";

const SIDE = 1000;

const points = (line: [number, number][]) => line.map(([x, y]) => `${SIDE * x},${SIDE * y}`).join(" ");

export function ImaginationPanel({ imagination }: { imagination: Imagination }) {
  const { block, lines, goal, explained, error, moved } = imagination;
  const data = useMemo(() => {
    const steps = error.map((_, i) => i * block);
    return [steps, imagination.imagined_to_goal, imagination.true_to_goal, error] as uPlot.AlignedData;
  }, [imagination]);
  const last = error.length - 1;
  // Paths that are flat need no square.
  const heights = [goal, ...lines.flatMap((line) => [...line.true, ...line.imagined])].map(([, y]) => SIDE * y);
  const [top, bottom] = [Math.min(...heights) - 60, Math.max(...heights) + 60];
  return (
    <section class="imagination" aria-label="Imagination">
      <Chart
        title="distance of latents"
        data={data}
        labels={["imagined to goal", "true to goal", "imagined to true"]}
        colours={[COLOURS[0], COLOURS[2], COLOURS[3]]}
        xLabel="step"
        height={150}
      />
      <figure class="fan-only">
        <svg class="fan" viewBox={`0 ${top} ${SIDE} ${bottom - top}`} role="img" aria-label="Imagined and true latents of the cheapest candidates">
          {lines.map((line, i) => (
            <g key={i} class={i === 0 ? "is-first" : ""}>
              <polyline class="true" points={points(line.true)} />
              <polyline class="imagined" points={points(line.imagined)} />
            </g>
          ))}
          <circle class="start" cx={SIDE * lines[0].true[0][0]} cy={SIDE * lines[0].true[0][1]} r={12} />
          <path class="target" d={`M${SIDE * goal[0] - 16},${SIDE * goal[1]}h32m-16,-16v32`} />
        </svg>
        <figcaption>
          Latents of the cheapest candidates of the last iteration: dashed as the model imagines them, solid as the frames of the environment
          are encoded; + is the goal (PCA, {Math.round(100 * explained)} % of the variance). After {last * block} steps the model is off by{" "}
          {short(error[last])}, where latents move by {short(moved[last])}.
        </figcaption>
      </figure>
    </section>
  );
}

// The frames of the cheapest candidate: what happens, the same through the decoder, and what the model predicts.
export function Frames({ frames, explained }: { frames: Decoded; explained?: number | null }) {
  const rows = [
    { name: "environment", images: frames.true, goal: frames.goal[0] },
    { name: "its latents, decoded", images: frames.decoded, goal: frames.goal[1] },
    { name: "imagined, decoded", images: frames.imagined, goal: undefined },
  ];
  return (
    <figure class="decoded" aria-label="What the model imagines">
      <table>
        <thead>
          <tr>
            <td />
            {frames.steps.map((step) => (
              <th key={step} scope="col">
                {step}
              </th>
            ))}
            <th scope="col">goal</th>
          </tr>
        </thead>
        <tbody>
          {rows.map(({ name, images, goal }) => (
            <tr key={name}>
              <th scope="row">{name}</th>
              {[...images, goal].map((jpeg, i) => (
                <td key={i}>
                  {jpeg && <img src={`data:image/jpeg;base64,${jpeg}`} alt={`${name}, ${i < images.length ? `step ${frames.steps[i]}` : "goal"}`} />}
                </td>
              ))}
            </tr>
          ))}
        </tbody>
      </table>
      <figcaption>
        The cheapest candidate of the last iteration. Where the last row differs from the middle one, the model is wrong; what the middle row
        lacks, the decoder did not find in the latents
        {typeof explained === "number" ? ` (${Math.round(100 * explained)} % of the variance of pixels on held-out episodes)` : ""}.
      </figcaption>
    </figure>
  );
}

const NO_DATASET = "none";

interface DecoderProps {
  env: string;
  model: Model;
  plans: Plans;
  // The folder and the name of the dataset, as in the address.
  chosen?: string;
}

// The choice of the dataset that a decoder is fitted to.
export function DecoderChoice({ env, model, plans, chosen }: DecoderProps) {
  const { send, ready, fitting } = plans;
  const listed = useLoaded(() => get<{ datasets: Dataset[] }>("datasets"), "datasets");
  const base = env.split(",")[0];
  const image = (dataset: Dataset) => dataset.columns?.some(({ name, shape }) => name === "pixels" && shape[0] === model.image);
  const fit = (listed.value?.datasets ?? []).filter((dataset) => dataset.env?.split(",")[0] === base && image(dataset));
  const names = fit.map(({ folder, name }) => `${folder}/${name}`);
  const value = chosen && names.includes(chosen) ? chosen : NO_DATASET;
  const isReady = ready?.model.name === model.name;
  useEffect(() => {
    if (!isReady || !listed.value) return;
    const [folder, name] = [value.slice(0, value.indexOf("/")), value.slice(value.indexOf("/") + 1)];
    send("decode", { dataset: value === NO_DATASET ? null : { folder: Number(folder), name } });
  }, [isReady, listed.value, value, plans.isClosed]);
  return (
    <>
      <div class="field is-wide" title="A decoder is fitted to the frames of this dataset; it shows what the model imagines">
        <Choice
          label="decode with"
          value={value}
          options={[NO_DATASET, ...names]}
          onChange={(next) => patch({ decode: next === NO_DATASET ? undefined : next })}
        />
      </div>
      {fitting && (
        <div class="bar">
          <progress value={fitting.done} max={fitting.total} aria-label="Fit of the decoder" />
          <button type="button" onClick={() => (send("enough"), patch({ decode: undefined }))}>
            Stop
          </button>
        </div>
      )}
      {listed.value && names.length === 0 && (
        <small>
          No dataset of {base} has frames of {model.image} px.
        </small>
      )}
    </>
  );
}
