// What a page may change at a step: the action, and a factor. Each begins a branch, if the step was continued already.

import { useState } from "preact/hooks";
import type { EnvInfo } from "./api";
import { Control as FactorControl } from "./factors";
import { Slider } from "./factors";
import { atRest } from "./hand";
import type { Plans } from "./plan-session";
import { Choice } from "./transport";
import { bounds, isInteger } from "./variation";

// Actions with more elements have no sliders.
const MOST_SLIDERS = 12;

export function PlanChanges({ info, plans }: { info: EnvInfo; plans: Plans }) {
  const { header, send } = plans;
  const [action, setAction] = useState(() => atRest(info.action));
  const [key, setKey] = useState(info.factors[0]?.key ?? "");
  const [value, setValue] = useState<{ key: string; value: number[] } | undefined>();
  const factor = info.factors.find((factor) => factor.key === key);
  const now = value?.key === key ? value.value : (header?.factors[key] ?? factor?.default ?? []);
  return (
    <details class="panel changes">
      <summary>
        Change something here <small class="muted">another action or factor at this step</small>
      </summary>
      <div class="pair">
        <div>
          {action.length <= MOST_SLIDERS &&
            action.map((element, i) => (
              <Slider
                key={i}
                label={`action[${i}]`}
                value={element}
                range={bounds(info.action, i)}
                integer={isInteger(info.action)}
                onChange={(changed) => setAction(action.map((v, j) => (i === j ? changed : v)))}
              />
            ))}
          <button type="button" onClick={() => send("act", { action })} disabled={header?.ended}>
            Take this action
          </button>
        </div>
        {factor && (
          <div>
            <Choice label="factor" value={key} options={info.factors.map((factor) => factor.key)} onChange={setKey} />
            <FactorControl factor={factor} value={now} onChange={(changed) => setValue({ key, value: changed })} />
            <button type="button" onClick={() => send("change", { factor: key, value: now })}>
              Change the factor
            </button>
          </div>
        )}
      </div>
    </details>
  );
}
