// The panels of a live environment: its action, and the recording of demonstrations.

import { useState } from "preact/hooks";
import type { Space } from "./api";
import { Slider } from "./factors";
import type { Recording, Send } from "./session";
import { bounds, isInteger } from "./variation";

interface ActionsProps {
  space: Space;
  action: number[];
  hint: string;
  onAct: (action: number[]) => void;
}

export function Actions({ space, action, hint, onAct }: ActionsProps) {
  return (
    <details class="panel" open={action.length <= 4}>
      <summary>
        Action <small class="muted">{hint}</small>
      </summary>
      {action.map((value, i) => (
        <Slider
          key={i}
          label={`action[${i}]`}
          value={value}
          range={bounds(space, i)}
          integer={isInteger(space)}
          onChange={(changed) => onAct(action.map((v, j) => (i === j ? changed : v)))}
        />
      ))}
    </details>
  );
}

interface RecorderProps {
  recording?: Recording;
  env: string;
  send: Send;
}

export function Recorder({ recording, env, send }: RecorderProps) {
  const [name, setName] = useState(() => `demos-${env.split("/")[1].split("-")[0].toLowerCase()}`);
  if (recording?.dataset) {
    return (
      <div class="bar panel is-recording" role="status">
        <span class="dot" aria-hidden="true" />
        <span>
          <b>{recording.dataset}</b>: {recording.episodes} episodes kept
          {recording.complete ? `, ${recording.rows} rows wait` : ""}
        </span>
        <span class="grow" />
        <button type="button" class={recording.complete ? "primary" : ""} onClick={() => send("keep")} title="k">
          Keep
        </button>
        <button type="button" onClick={() => send("discard")} title="d">
          Discard
        </button>
        <button type="button" onClick={() => send("finish")}>
          Finish
        </button>
      </div>
    );
  }
  return (
    <form
      class="bar panel"
      onSubmit={(event) => {
        event.preventDefault();
        send("record", { dataset: name });
      }}
    >
      <label class="grow">
        Record into
        <input
          type="text"
          value={name}
          pattern="[A-Za-z0-9_][A-Za-z0-9_\-]*"
          maxLength={64}
          required
          aria-label="Name of the dataset"
          onInput={(event) => setName(event.currentTarget.value)}
        />
      </label>
      <button type="submit">Record</button>
    </form>
  );
}
