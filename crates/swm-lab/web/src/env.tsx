// The page of environments: choose one, see it move, turn its factors, drive it, record demonstrations.

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { address, type EnvInfo, type EnvRow, get } from "./api";
import { FactorRow } from "./factors";
import { short } from "./format";
import { atRest, isArrow, isPointed, ofArrows, towards } from "./hand";
import { useLive } from "./live";
import { Actions, Recorder } from "./panels";
import type { Header } from "./session";
import { type Params, patch, useKeys, useLoaded } from "./state";
import { formatPins, formatSampled, parsePins, sampledKeys } from "./variation";

const FIRST = "swm/PushT-v1";
const SIDES = [96, 128, 224, 320, 448];
const SPEEDS = [1, 5, 10, 20, 30, 60, 120];

export function EnvPage({ params }: { params: Params }) {
  const list = useLoaded(() => get<EnvRow[]>("envs"), "envs");
  const id = params.env || FIRST;
  const info = useLoaded(() => get<EnvInfo>("env", { env: id }), id);
  return (
    <div class="envs">
      <EnvList rows={list.value ?? []} id={id} />
      {info.error && (
        <p class="error" role="alert">
          {info.error}
        </p>
      )}
      {info.value ? <LiveEnv key={id} info={info.value} params={params} /> : !info.error && <p class="loading">Loading {id} …</p>}
    </div>
  );
}

function EnvList({ rows, id }: { rows: EnvRow[]; id: string }) {
  const [filter, setFilter] = useState("");
  const name = id.split(",")[0];
  const shown = rows.filter((row) => `${row.id} ${row.summary}`.toLowerCase().includes(filter.toLowerCase()));
  const choose = (env: string) => patch({ env, pin: undefined, variation: undefined, seed: undefined, by: undefined });
  return (
    <aside class="list" aria-label="Environments">
      <input
        type="search"
        placeholder="Filter environments"
        aria-label="Filter environments"
        value={filter}
        onInput={(event) => setFilter(event.currentTarget.value)}
      />
      <select class="narrow" aria-label="Environment" value={name} onChange={(event) => choose(event.currentTarget.value)}>
        {rows.map((row) => (
          <option key={row.id} value={row.id}>
            {row.id}
          </option>
        ))}
      </select>
      <ul class="wide">
        {shown.map((row) => (
          <li key={row.id}>
            <button type="button" aria-current={row.id === name} title={row.summary} onClick={() => choose(row.id)}>
              <span>{row.id.replace("swm/", "")}</span>
              <small>{row.summary}</small>
            </button>
          </li>
        ))}
        {shown.length === 0 && <li class="muted">No environment contains “{filter}”.</li>}
      </ul>
    </aside>
  );
}

function LiveEnv({ info, params }: { info: EnvInfo; params: Params }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const side = Number(params.image) || 224;
  const seed = Math.max(0, Math.floor(Number(params.seed) || 0));
  const by = params.by || info.experts[0]?.id || "random";
  const fps = Number(params.fps) || 30;
  const [hand, setHand] = useState(() => atRest(info.action));
  const point = useRef<[number, number] | undefined>(undefined);
  const held = useRef(new Set<string>());
  const onHeader = (header: Header) => {
    if (point.current) live.send("act", { action: towards(point.current, header.state) });
    if (header.terminated || header.truncated) setWantsPlay(false);
  };
  const live = useLive(info.id, side, canvas, onHeader);
  const { header, started, send } = live;
  const [wantsPlay, setWantsPlay] = useState(false);

  const pins = useMemo(() => parsePins(params.pin ?? ""), [params.pin]);
  const sampled = useMemo(() => sampledKeys(info.factors, params.variation), [info, params.variation]);
  const reset = () => send("reset", { seed, pin: params.pin ?? "", variation: params.variation });
  // A new connection starts from the URL; later changes of the URL start another episode.
  const setup = JSON.stringify([seed, params.pin, params.variation]);
  useEffect(() => reset(), [setup, live.send, side, live.isClosed]);
  useEffect(() => send("drive", { by }), [by, side, live.isClosed]);
  useEffect(() => send("speed", { fps }), [fps, side, live.isClosed]);

  const ended = Boolean(header && (header.terminated || header.truncated));
  const play = (on: boolean) => {
    if (on && ended) reset();
    send("play", { on });
    setWantsPlay(on);
  };
  const isPlaying = header?.playing ?? wantsPlay;
  const next = () => patch({ seed: String(seed + 1) });
  const randomise = () => patch({ seed: String(seed + 1), variation: "all", pin: undefined });
  const take = () => {
    if (by !== "hand") patch({ by: "hand" });
  };
  const act = (action: number[]) => {
    setHand(action);
    send("act", { action });
  };
  useArrows((key, down) => {
    if (down) held.current.add(key);
    else held.current.delete(key);
    take();
    act(ofArrows(info.action, held.current, atRest(info.action)));
    if (down && !isPlaying && !ended) play(true);
  });
  const command = started?.command ?? "";
  const copy = () => void navigator.clipboard?.writeText(command);
  useKeys({
    " ": () => play(!isPlaying),
    ".": () => send("step"),
    r: reset,
    n: next,
    v: randomise,
    c: copy,
    k: () => send("keep"),
    d: () => send("discard"),
  });

  const pointed = (event: PointerEvent) => {
    const box = canvas.current?.getBoundingClientRect();
    if (!box || !isPointed(info.id)) return;
    point.current = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
    take();
    if (header) send("act", { action: towards(point.current, header.state) });
    if (!isPlaying && !ended) play(true);
  };
  const released = () => {
    if (!point.current) return;
    point.current = undefined;
    act(atRest(info.action));
  };

  return (
    <>
      <section class="stage" aria-label={info.id}>
        <h1>
          {info.id} <small>{info.summary}</small>
        </h1>
        <div class={`frame ${isPointed(info.id) ? "is-pointed" : ""}`}>
          <canvas
            ref={canvas}
            role="img"
            aria-label={`Frame of ${info.id} at step ${header?.step ?? 0}`}
            onPointerDown={(event) => {
              event.currentTarget.setPointerCapture(event.pointerId);
              pointed(event);
            }}
            onPointerMove={(event) => event.buttons > 0 && pointed(event)}
            onPointerUp={released}
            onPointerCancel={released}
          />
          {ended && (
            <div class={`ended ${header?.success ? "is-success" : ""}`}>
              {header?.success ? "goal reached" : header?.truncated ? "time limit" : "ended"}
            </div>
          )}
        </div>
        <Transport
          seed={seed}
          isPlaying={isPlaying}
          by={by}
          fps={fps}
          side={side}
          info={info}
          onPlay={() => play(!isPlaying)}
          onStep={() => send("step")}
          onReset={reset}
          onNext={next}
        />
        <Readout header={header} fps={live.fps} limit={info.max_episode_steps} />
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
        {by === "hand" && (
          <Actions space={info.action} action={hand} onAct={act} hint={isPointed(info.id) ? "Drag on the frame." : "Hold the arrow keys."} />
        )}
        <Recorder recording={live.recording} env={info.id} send={send} onStart={() => setWantsPlay(false)} />
        <div class="command" aria-label="Command">
          <code data-testid="command">{command}</code>
          <button type="button" onClick={copy} disabled={!command}>
            Copy
          </button>
          <a
            class="button"
            data-testid="still"
            href={address("still", { env: info.id, seed, image: side, pin: params.pin, variation: params.variation })}
            target="_blank"
            rel="noreferrer"
          >
            PNG
          </a>
        </div>
      </section>
      <aside class="factors" aria-label="Factors of variation">
        <div class="bar">
          <h2>Factors</h2>
          <span class="grow" />
          <button type="button" onClick={randomise} title="Sample all, with the next seed">
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
                value={pins[factor.key] ?? started?.factors[factor.key] ?? factor.default}
                pinned={factor.key in pins}
                sampled={sampled.has(factor.key)}
                onPin={(value) => {
                  const { [factor.key]: _, ...others } = pins;
                  patch({ pin: formatPins(value ? { ...others, [factor.key]: value } : others) });
                }}
                onSample={(on) => {
                  const keys = new Set(sampled);
                  if (on) keys.add(factor.key);
                  else keys.delete(factor.key);
                  const { [factor.key]: _, ...others } = pins;
                  patch({ variation: formatSampled(info.factors, keys), pin: formatPins(others) });
                }}
              />
            ))}
          </details>
        ))}
        {info.factors.length === 0 && <p class="muted">This environment has no factors.</p>}
      </aside>
    </>
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

// Calls `changed` when an arrow key is pressed or released outside of fields.
function useArrows(changed: (key: string, down: boolean) => void): void {
  const current = useRef(changed);
  current.current = changed;
  useEffect(() => {
    const handle = (event: KeyboardEvent) => {
      if (!isArrow(event.key) || event.repeat) {
        if (isArrow(event.key) && !(event.target as HTMLElement).closest("input, select")) event.preventDefault();
        return;
      }
      if (event.type === "keydown" && (event.target as HTMLElement).closest("input, select, textarea, dialog")) return;
      event.preventDefault();
      current.current(event.key, event.type === "keydown");
    };
    addEventListener("keydown", handle);
    addEventListener("keyup", handle);
    return () => {
      removeEventListener("keydown", handle);
      removeEventListener("keyup", handle);
    };
  }, []);
}

interface TransportProps {
  seed: number;
  isPlaying: boolean;
  by: string;
  fps: number;
  side: number;
  info: EnvInfo;
  onPlay: () => void;
  onStep: () => void;
  onReset: () => void;
  onNext: () => void;
}

function Transport({ seed, isPlaying, by, fps, side, info, onPlay, onStep, onReset, onNext }: TransportProps) {
  const drivers = [...info.experts.map((expert) => expert.id), "random", "hand"];
  return (
    <div class="bar transport" role="toolbar" aria-label="Playback">
      <button type="button" class="primary" onClick={onPlay} aria-label={isPlaying ? "Pause" : "Play"} title="Space">
        {isPlaying ? "❚❚" : "▶"}
      </button>
      <button type="button" onClick={onStep} aria-label="Step" title="One step (.)">
        ▸|
      </button>
      <button type="button" onClick={onReset} title="Reset with the same seed (r)">
        Reset
      </button>
      <label>
        seed
        <input
          type="number"
          class="value"
          min={0}
          value={seed}
          onChange={(event) => patch({ seed: String(Math.max(0, Math.floor(Number(event.currentTarget.value) || 0))) })}
        />
      </label>
      <button type="button" onClick={onNext} title="Reset with the next seed (n)">
        Next
      </button>
      <span class="grow" />
      <Choice label="driver" value={by} options={drivers} onChange={(value) => patch({ by: value })} />
      <Choice label="steps/s" value={String(fps)} options={SPEEDS.map(String)} onChange={(value) => patch({ fps: value })} />
      <Choice label="px" value={String(side)} options={SIDES.map(String)} onChange={(value) => patch({ image: value })} />
    </div>
  );
}

function Choice(props: { label: string; value: string; options: string[]; onChange: (value: string) => void }) {
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

function Readout({ header, fps, limit }: { header?: Header; fps: number; limit: number }) {
  const values: [string, string][] = [
    ["step", `${header?.step ?? 0} / ${limit}`],
    ["reward", short(header?.reward)],
    ["return", short(header?.total)],
    ["goal", header?.success ? "reached" : "not reached"],
    ["frames/s", String(header?.playing ? fps : 0)],
  ];
  return (
    <dl class="readout">
      {values.map(([name, value]) => (
        <div key={name} class={name === "goal" && header?.success ? "is-success" : ""}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
      <div class="state" title={header?.state.map(short).join(", ")}>
        <dt>state</dt>
        <dd>{header?.state.map(short).join(" ") ?? "–"}</dd>
      </div>
    </dl>
  );
}
