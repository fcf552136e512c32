// A live environment: its frame, its playback, the command that writes its first frame, and its factors.

import { useRef } from "preact/hooks";
import { address, type EnvInfo } from "./api";
import { type Control, showBeside, type Side, stillOf, useControl } from "./control";
import { chooseEnv } from "./env";
import { FactorRow } from "./factors";
import { short } from "./format";
import { isPointed } from "./hand";
import { Actions, Recorder } from "./panels";
import { Views, Wrappers } from "./rendering";
import { CollectForm } from "./start";
import { type Params, patch } from "./state";
import { Choice, Readout, Transport } from "./transport";
import { formatPins, formatSampled } from "./variation";

// Differing factors that are listed.
const MOST_DIFFERENT = 6;

export function LiveEnv({ info, params }: { info: EnvInfo; params: Params }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const second = useRef<HTMLCanvasElement>(null);
  const control = useControl(info, params, canvas, second);
  const { live, settings, beside, edited } = control;
  const { rendering } = edited.settings;
  return (
    <>
      <section class="stage" aria-label={info.id}>
        <h1>
          {info.id} <small>{info.summary}</small>
        </h1>
        <div class="bar">
          <Options info={info} />
          <Views info={info} view={rendering.view} onView={(view) => control.change({ view, wrap: undefined, wrapgoal: undefined })} />
        </div>
        <div class="frames">
          <Frame info={info} control={control} side={control} canvas={canvas} name={beside && "left"} />
          {beside && <Frame info={info} control={control} side={beside} canvas={second} name="right" />}
          {params.versus && <Versus src={params.versus} side={settings.side} />}
        </div>
        {beside && <Difference left={control} right={beside} />}
        <Transport info={info} control={control} />
        <Readout header={live.header} fps={live.fps} limit={info.max_episode_steps} />
        {beside && <Readout header={beside.live.header} fps={beside.live.fps} limit={info.max_episode_steps} />}
        <Problems live={live} />
        {beside && <Problems live={beside.live} />}
        {settings.by === "hand" && (
          <Actions
            space={info.action}
            action={control.hand}
            onAct={control.act}
            hint={`${isPointed(info.id) ? "Drag on the frame" : "Hold the arrow keys"}, or use a gamepad.`}
          />
        )}
        <Wrappers
          rendering={rendering}
          onChange={(wrappers, goal) => control.change({ wrap: wrappers.join(";"), wrapgoal: goal ? "1" : undefined })}
        />
        <Recorder recording={live.recording} env={info.id} send={live.send} />
        <Command info={info} control={control} params={params} />
        <CollectForm info={info} params={params} />
      </section>
      <Factors info={info} control={control} params={params} />
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
    <>
      {info.options.map(({ key, values }) => (
        <Choice
          key={key}
          label={key}
          value={chosen[key] ?? values[0]}
          options={values}
          onChange={(value) => change(key, value)}
        />
      ))}
    </>
  );
}

interface FrameProps {
  info: EnvInfo;
  control: Control;
  side: Side;
  canvas: { current: HTMLCanvasElement | null };
  name?: string;
}

function Frame({ info, control, side, canvas, name }: FrameProps) {
  const { header } = side.live;
  const move = (event: PointerEvent) => {
    const box = canvas.current?.getBoundingClientRect();
    if (box) control.point([(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height]);
  };
  const release = () => control.point(undefined);
  const outcome = header?.success ? "goal reached" : header?.truncated ? "time limit" : "ended";
  return (
    <div
      class={`frame ${isPointed(info.id) ? "is-pointed" : ""} ${name ? "is-side" : ""} ${name && side.live === control.edited.live ? "is-edited" : ""}`}
      data-name={name}
    >
      <canvas
        ref={canvas}
        role="img"
        aria-label={`${name ? `${name} f` : "F"}rame of ${info.id} at step ${header?.step ?? 0}`}
        onPointerDown={(event) => {
          event.currentTarget.setPointerCapture(event.pointerId);
          move(event);
        }}
        onPointerMove={(event) => event.buttons > 0 && move(event)}
        onPointerUp={release}
        onPointerCancel={release}
      />
      {side.ended && <div class={`ended ${header?.success ? "is-success" : ""}`}>{outcome}</div>}
    </div>
  );
}

// The factors in which two settings differ.
function Difference({ left, right }: { left: Side; right: Side }) {
  const [a, b] = [left, right].map((side) => side.live.started?.factors ?? {});
  const keys = Object.keys(a).filter((key) => b[key] && String(a[key]) !== String(b[key]));
  const words = (values: number[]) => values.map(short).join(", ");
  return (
    <div class="bar difference" role="status" aria-label="Difference">
      {keys.length === 0 && <span class="muted">No factor differs.</span>}
      {keys.slice(0, MOST_DIFFERENT).map((key) => (
        <span key={key}>
          {key}: <b>{words(a[key])}</b> | <b>{words(b[key])}</b>
        </span>
      ))}
      {keys.length > MOST_DIFFERENT && <span class="muted">and {keys.length - MOST_DIFFERENT} more</span>}
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

function Command({ info, control, params }: { info: EnvInfo; control: Control; params: Params }) {
  const { edited, copy } = control;
  const { settings, live } = edited;
  const { command = "", python } = live.started ?? {};
  const given = Object.entries({ env: info.id, ...stillOf(settings) }).filter(([, value]) => value !== undefined && value !== "" && value !== false);
  const query = Object.fromEntries(given);
  const keep = (goal?: boolean) =>
    patch({ versus: new URLSearchParams([...given, ...(goal ? [["goal", true]] : [])].map(([key, value]) => [String(key), String(value)])).toString() });
  return (
    <div class="command" aria-label="Command">
      <code data-testid="command">{command}</code>
      <button type="button" onClick={copy} disabled={!command} title="Copy the command (c)">
        Copy
      </button>
      <button
        type="button"
        onClick={() => void navigator.clipboard?.writeText(python ?? "")}
        disabled={!python}
        title={python === null ? "Only the colour of the default camera without wrappers has a program" : "Copy the Python program that renders the frame"}
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
      <button type="button" onClick={() => keep()} aria-pressed={Boolean(params.versus)} title="Keep this frame beside the next settings">
        Compare
      </button>
      <button
        type="button"
        onClick={() => (control.beside ? patch({ beside: undefined, edit: undefined }) : showBeside(params))}
        aria-pressed={Boolean(control.beside)}
        title="Other settings live beside these, with the same seed and the same driver"
      >
        Side by side
      </button>
      <button type="button" onClick={() => keep(true)} disabled={Boolean(settings.rendering.view)} title="Show the goal beside the frame">
        Goal
      </button>
    </div>
  );
}

function Factors({ info, control, params }: { info: EnvInfo; control: Control; params: Params }) {
  const { edited } = control;
  const { pins, sampled } = edited.settings;
  const values = edited.live.started?.factors ?? {};
  const without = (key: string) => {
    const { [key]: _, ...others } = pins;
    return others;
  };
  const sample = (key: string, on: boolean) => {
    const keys = new Set(sampled);
    if (on) keys.add(key);
    else keys.delete(key);
    control.change({ variation: formatSampled(info.factors, keys), pin: formatPins(without(key)) });
  };
  return (
    <aside class="factors" aria-label="Factors of variation">
      <div class="bar">
        <h2>Factors</h2>
        <span class="grow" />
        <button type="button" onClick={control.randomise} title="Sample all, with the next seed (v)">
          Randomise
        </button>
        <button type="button" onClick={() => control.change({ pin: undefined, variation: undefined })}>
          Defaults
        </button>
      </div>
      {control.beside && (
        <div class="control segments" role="radiogroup" aria-label="Whose settings">
          {["left", "right"].map((name) => (
            <button
              type="button"
              role="radio"
              key={name}
              aria-checked={(params.edit === "right") === (name === "right")}
              onClick={() => patch({ edit: name === "right" ? name : undefined })}
            >
              {name}
            </button>
          ))}
        </div>
      )}
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
                control.change({ pin: formatPins(value ? { ...without(factor.key), [factor.key]: value } : without(factor.key)) })
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
