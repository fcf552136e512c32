// A live environment: its frame, its playback, the command that writes its first frame, and its factors.

import { useRef } from "preact/hooks";
import { address, type EnvInfo } from "./api";
import { type Control, type Settings, useControl } from "./control";
import { chooseEnv } from "./env";
import { FactorRow } from "./factors";
import { isPointed } from "./hand";
import { Actions, Recorder } from "./panels";
import { type Params, patch } from "./state";
import { Choice, Readout, Transport } from "./transport";
import { formatPins, formatSampled } from "./variation";

export function LiveEnv({ info, params }: { info: EnvInfo; params: Params }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const control = useControl(info, params, canvas);
  const { live, settings } = control;
  return (
    <>
      <section class="stage" aria-label={info.id}>
        <h1>
          {info.id} <small>{info.summary}</small>
        </h1>
        <Options info={info} />
        <div class="frames">
          <Frame info={info} control={control} canvas={canvas} />
          {params.versus && <Versus src={params.versus} side={settings.side} />}
        </div>
        <Transport info={info} control={control} />
        <Readout header={live.header} fps={live.fps} limit={info.max_episode_steps} />
        <Problems live={live} />
        {settings.by === "hand" && (
          <Actions
            space={info.action}
            action={control.hand}
            onAct={control.act}
            hint={isPointed(info.id) ? "Drag on the frame." : "Hold the arrow keys."}
          />
        )}
        <Recorder recording={live.recording} env={info.id} send={live.send} />
        <Command info={info} control={control} isCompared={Boolean(params.versus)} />
      </section>
      <Factors info={info} control={control} />
    </>
  );
}

// The options of an environment are a part of its id: `ID,key=value`.
function Options({ info }: { info: EnvInfo }) {
  const [id, ...given] = info.id.split(",");
  const chosen = Object.fromEntries(given.map((option) => option.split("=")));
  if (info.options.length === 0) return null;
  const change = (key: string, value: string) => {
    const all = { ...chosen, [key]: value };
    const other = info.options.filter((option) => all[option.key] && all[option.key] !== option.values[0]);
    chooseEnv([id, ...other.map((option) => `${option.key}=${all[option.key]}`)].join(","));
  };
  return (
    <div class="bar">
      {info.options.map(({ key, values }) => (
        <Choice
          key={key}
          label={key}
          value={chosen[key] ?? values[0]}
          options={values}
          onChange={(value) => change(key, value)}
        />
      ))}
    </div>
  );
}

interface FrameProps {
  info: EnvInfo;
  control: Control;
  canvas: { current: HTMLCanvasElement | null };
}

function Frame({ info, control, canvas }: FrameProps) {
  const { header } = control.live;
  const move = (event: PointerEvent) => {
    const box = canvas.current?.getBoundingClientRect();
    if (box) control.point([(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]);
  };
  const release = () => control.point(undefined);
  const outcome = header?.success ? "goal reached" : header?.truncated ? "time limit" : "ended";
  return (
    <div class={`frame ${isPointed(info.id) ? "is-pointed" : ""}`}>
      <canvas
        ref={canvas}
        role="img"
        aria-label={`Frame of ${info.id} at step ${header?.step ?? 0}`}
        onPointerDown={(event) => {
          event.currentTarget.setPointerCapture(event.pointerId);
          move(event);
        }}
        onPointerMove={(event) => event.buttons > 0 && move(event)}
        onPointerUp={release}
        onPointerCancel={release}
      />
      {control.ended && <div class={`ended ${header?.success ? "is-success" : ""}`}>{outcome}</div>}
    </div>
  );
}

// The first frame with other settings, which were kept to compare with.
function Versus({ src, side }: { src: string; side: number }) {
  const query = Object.fromEntries(new URLSearchParams(src));
  return (
    <figure class="frame versus">
      <img src={address("still", { ...query, image: side })} alt={`First frame with ${src}`} />
      <button type="button" class="ended" onClick={() => patch({ versus: undefined })} aria-label="Stop comparing">
        {query.goal ? "goal" : "kept"} ×
      </button>
    </figure>
  );
}

interface Connection {
  error?: string;
  isClosed: boolean;
  dismiss: () => void;
  reconnect: () => void;
}

export function Problems({ live }: { live: Connection }) {
  return (
    <>
      {live.error && (
        <p class="error" role="alert">
          {live.error}{" "}
          <button type="button" class="quiet" onClick={live.dismiss} aria-label="Dismiss">
            ×
          </button>
        </p>
      )}
      {live.isClosed && (
        <p class="error" role="alert">
          The lab closed the connection.{" "}
          <button type="button" onClick={live.reconnect}>
            Connect again
          </button>
        </p>
      )}
    </>
  );
}

function still(info: EnvInfo, { seed, pin, variation }: Settings) {
  return { env: info.id, seed, pin: pin || undefined, variation };
}

function Command({ info, control, isCompared }: { info: EnvInfo; control: Control; isCompared: boolean }) {
  const { live, settings, copy } = control;
  const command = live.started?.command ?? "";
  const query = still(info, settings);
  const keep = (goal?: boolean) => {
    const given = Object.entries({ ...query, goal }).filter(([, value]) => value !== undefined);
    patch({ versus: new URLSearchParams(given.map(([key, value]) => [key, String(value)])).toString() });
  };
  return (
    <div class="command" aria-label="Command">
      <code data-testid="command">{command}</code>
      <button type="button" onClick={copy} disabled={!command} title="Copy the command (c)">
        Copy
      </button>
      <button
        type="button"
        onClick={() => void navigator.clipboard?.writeText(live.started?.python ?? "")}
        disabled={!command}
        title="Copy the Python program that renders the frame"
      >
        Python
      </button>
      <a
        class="button"
        data-testid="still"
        href={address("still", { ...query, image: settings.side })}
        target="_blank"
        rel="noreferrer"
        title="The frame that the command writes"
      >
        PNG
      </a>
      <button type="button" onClick={() => keep()} aria-pressed={isCompared} title="Keep this frame beside the next settings">
        Compare
      </button>
      <button type="button" onClick={() => keep(true)} title="Show the goal beside the frame">
        Goal
      </button>
    </div>
  );
}

function Factors({ info, control }: { info: EnvInfo; control: Control }) {
  const { pins, sampled } = control.settings;
  const values = control.live.started?.factors ?? {};
  const without = (key: string) => {
    const { [key]: _, ...others } = pins;
    return others;
  };
  const sample = (key: string, on: boolean) => {
    const keys = new Set(sampled);
    if (on) keys.add(key);
    else keys.delete(key);
    patch({ variation: formatSampled(info.factors, keys), pin: formatPins(without(key)) });
  };
  return (
    <aside class="factors" aria-label="Factors of variation">
      <div class="bar">
        <h2>Factors</h2>
        <span class="grow" />
        <button type="button" onClick={control.randomise} title="Sample all, with the next seed (v)">
          Randomise
        </button>
        <button type="button" onClick={() => patch({ pin: undefined, variation: undefined })}>
          Defaults
        </button>
      </div>
      {groups(info).map(([group, factors]) => (
        <details open key={group}>
          <summary>{group}</summary>
          {factors.map((factor) => (
            <FactorRow
              key={factor.key}
              factor={factor}
              value={pins[factor.key] ?? values[factor.key] ?? factor.default}
              pinned={factor.key in pins}
              sampled={sampled.has(factor.key)}
              onPin={(value) =>
                patch({ pin: formatPins(value ? { ...without(factor.key), [factor.key]: value } : without(factor.key)) })
              }
              onSample={(on) => sample(factor.key, on)}
            />
          ))}
        </details>
      ))}
      {info.factors.length === 0 && <p class="muted">This environment has no factors.</p>}
    </aside>
  );
}

function groups(info: EnvInfo): [string, EnvInfo["factors"]][] {
  const found = new Map<string, EnvInfo["factors"]>();
  for (const factor of info.factors) {
    const group = factor.key.split(".")[0];
    found.set(group, [...(found.get(group) ?? []), factor]);
  }
  return [...found];
}
