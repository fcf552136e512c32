// What a world model imagines of the cheapest candidates, beside what they lead to.

import { useMemo } from "preact/hooks";
import type uPlot from "uplot";
import { Chart, COLOURS } from "./chart";
import { short } from "./format";
import type { Imagination } from "./plan-session";

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
