// Named values of a step, and its state.

import { short } from "./format";

export function Values({ values, success, state }: { values: [string, string][]; success?: boolean; state?: number[] }) {
  return (
    <dl class="readout">
      {values.map(([name, value]) => (
        <div key={name} class={name === "goal" && success ? "is-success" : ""}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
      <div class="state" title={state?.map(short).join(", ")}>
        <dt>state</dt>
        <dd>{state?.map(short).join(" ") ?? "–"}</dd>
      </div>
    </dl>
  );
}
