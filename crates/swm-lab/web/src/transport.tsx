// Playback of a live environment, and the values of its newest frame.

import type { EnvInfo } from "./api";
import type { Control } from "./control";
import { short } from "./format";
import type { Header } from "./session";
import { patch } from "./state";
import { Values } from "./values";

const SIDES = [64, 96, 128, 224, 320, 448];
const SPEEDS = [1, 5, 10, 20, 30, 60, 120];

export function Transport({ info, control }: { info: EnvInfo; control: Control }) {
  const { isPlaying, settings, send } = control;
  const drivers = [...info.experts.map((expert) => expert.id), "random", "hand"];
  const seed = (text: string) => patch({ seed: String(Math.max(0, Math.floor(Number(text) || 0))) });
  return (
    <div class="bar transport" role="toolbar" aria-label="Playback">
      <button
        type="button"
        class="primary"
        onClick={() => control.play(!isPlaying)}
        aria-label={isPlaying ? "Pause" : "Play"}
        title="Space"
      >
        {isPlaying ? "❚❚" : "▶"}
      </button>
      <button type="button" onClick={() => send("step")} aria-label="Step" title="One step (.)">
        ▸|
      </button>
      <button type="button" onClick={control.reset} title="Reset with the same seed (r)">
        Reset
      </button>
      <label>
        seed
        <input
          type="number"
          class="value"
          min={0}
          value={settings.seed}
          onChange={(event) => seed(event.currentTarget.value)}
        />
      </label>
      <button type="button" onClick={control.next} title="Reset with the next seed (n)">
        Next
      </button>
      <label title="Go on with the next seed when an episode has ended">
        <input
          type="checkbox"
          checked={settings.loop}
          onChange={(event) => patch({ loop: event.currentTarget.checked ? "1" : undefined })}
        />
        loop
      </label>
      <span class="grow" />
      <Choice label="driver" value={settings.by} options={drivers} onChange={(value) => patch({ by: value })} />
      <Choice
        label="steps/s"
        value={String(settings.fps)}
        options={SPEEDS.map(String)}
        onChange={(value) => patch({ fps: value })}
      />
      <Choice
        label="px"
        value={String(settings.side)}
        options={SIDES.map(String)}
        onChange={(value) => patch({ image: value })}
      />
    </div>
  );
}

export function Choice(props: { label: string; value: string; options: string[]; onChange: (value: string) => void }) {
  const options = props.options.includes(props.value) ? props.options : [...props.options, props.value];
  return (
    <label>
      {props.label}
      <select value={props.value} onChange={(event) => props.onChange(event.currentTarget.value)}>
        {options.map((option) => (
          <option key={option}>{option}</option>
        ))}
      </select>
    </label>
  );
}

export function Readout({ header, fps, limit }: { header?: Header; fps: number; limit: number }) {
  const values: [string, string][] = [
    ["step", `${header?.step ?? 0} / ${limit}`],
    ["reward", short(header?.reward)],
    ["return", short(header?.total)],
    ["goal", header?.success ? "reached" : "not reached"],
    ["frames/s", String(header?.playing ? fps : 0)],
  ];
  return <Values values={values} success={header?.success} state={header?.state} />;
}
