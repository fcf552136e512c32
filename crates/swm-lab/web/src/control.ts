// What a page does with a live environment, or with two settings of it: it keeps them in step with the page's address, plays, and
// takes over.

import type { RefObject } from "preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { EnvInfo } from "./api";
import { useGamepad } from "./gamepad";
import { atRest, isPointed, ofArrows, towards, useArrows } from "./hand";
import { type Live, useLive } from "./live";
import type { Rendering } from "./rendering";
import type { Header, Send } from "./session";
import { type Params, patch, useKeys } from "./state";
import { type Pins, parsePins, sampledKeys } from "./variation";

// The time between the end of an episode and the next one, in milliseconds.
const PAUSE = 700;
// The parameters of the address that two sides have each for themselves.
const OF_SIDE = ["pin", "variation", "view", "wrap", "wrapgoal"] as const;

type Change = Partial<Record<(typeof OF_SIDE)[number], string | undefined>>;

export interface Settings {
  side: number;
  seed: number;
  by: string;
  fps: number;
  loop: boolean;
  pin: string;
  variation?: string;
  pins: Pins;
  sampled: Set<string>;
  rendering: Rendering;
}

// A live environment and its settings.
export interface Side {
  settings: Settings;
  live: Live;
  ended: boolean;
  reset: () => void;
}

export interface Control extends Side {
  // The other settings beside; they step together.
  beside?: Side;
  // Whose settings the controls change.
  edited: Side;
  hand: number[];
  isPlaying: boolean;
  send: Send;
  play: (on: boolean) => void;
  next: () => void;
  randomise: () => void;
  change: (change: Change) => void;
  act: (action: number[]) => void;
  copy: () => void;
  point: (at: [number, number] | undefined) => void;
}

export function useSettings(info: EnvInfo, params: Params): Settings {
  return useMemo(
    () => ({
      side: Number(params.image) || 224,
      seed: Math.max(0, Math.floor(Number(params.seed) || 0)),
      by: params.by || info.experts[0]?.id || "random",
      fps: Number(params.fps) || 30,
      loop: params.loop === "1",
      pin: params.pin ?? "",
      variation: params.variation,
      pins: parsePins(params.pin ?? ""),
      sampled: sampledKeys(info.factors, params.variation),
      rendering: {
        view: params.view,
        wrappers: (params.wrap ?? "").split(";").filter(Boolean),
        wrapGoal: params.wrapgoal === "1",
      },
    }),
    [info, params],
  );
}

// The settings that the server and `swm frame` need for the frame of a side.
export function stillOf({ seed, pin, variation, rendering }: Settings) {
  return {
    seed,
    pin,
    variation,
    view: rendering.view,
    wrappers: rendering.wrappers.join(";"),
    wrap_goal: rendering.wrapGoal,
  };
}

const hasEnded = (header: Header | undefined) => Boolean(header && (header.terminated || header.truncated));

// Connects to an environment, no id for none, and keeps it in step with its settings. Another `episode` begins one.
function useSide(
  id: string,
  settings: Settings,
  episode: string,
  canvas: RefObject<HTMLCanvasElement | null>,
  arrived: (header: Header) => void,
): Side {
  const { side, by, fps } = settings;
  const live = useLive(id, side, canvas, arrived);
  const { send, isClosed } = live;
  const reset = () => send("reset", stillOf(settings));
  // A new connection starts from the address; later changes of the address start another episode.
  useEffect(reset, [id, episode, side, isClosed]);
  useEffect(() => send("drive", { by }), [id, by, side, isClosed]);
  useEffect(() => send("speed", { fps }), [id, fps, side, isClosed]);
  return { settings, live, ended: hasEnded(live.header), reset };
}

// The parameters of the settings beside, whose own ones are in `beside`.
function ofBeside(params: Params): Params | undefined {
  if (params.beside === undefined) return undefined;
  const others = Object.entries(params).filter(([key]) => !(OF_SIDE as readonly string[]).includes(key));
  return { ...Object.fromEntries(others), ...Object.fromEntries(new URLSearchParams(params.beside)) };
}

// Shows the present settings beside, to be changed. A parameter of the address is not empty, so that defaults have a name.
export function showBeside(params: Params): void {
  patch({ beside: inBeside(params), edit: "right", versus: undefined });
}

function inBeside(of: Params): string {
  const given = OF_SIDE.filter((key) => of[key]).map((key) => [key, of[key]]);
  return new URLSearchParams(given).toString() || "defaults";
}

export function useControl(
  info: EnvInfo,
  params: Params,
  canvas: RefObject<HTMLCanvasElement | null>,
  second: RefObject<HTMLCanvasElement | null>,
): Control {
  const [wantsPlay, setWantsPlay] = useState(false);
  const [hand, setHand] = useState(() => atRest(info.action));
  const pointed = useRef<[number, number] | undefined>(undefined);
  const besideParams = useMemo(() => ofBeside(params), [params]);
  const together = useTogether();
  const settings = useSettings(info, params);
  const others = useSettings(info, besideParams ?? params);
  // Both begin their episodes together.
  const episode = JSON.stringify([stillOf(settings), besideParams ? stillOf(others) : undefined]);
  const left = useSide(info.id, settings, episode, canvas, (header) => {
    if (pointed.current) send("act", { action: towards(pointed.current, header.state) });
    if (!besideParams && hasEnded(header)) setWantsPlay(false);
    together.arrived(0, header);
  });
  const right = useSide(besideParams ? info.id : "", others, episode, second, (header) => together.arrived(1, header));
  const beside = besideParams && right;
  const sides = beside ? [left, beside] : [left];
  const edited = beside && params.edit === "right" ? beside : left;
  const { live } = left;
  const { seed, by, fps, loop } = settings;
  const send: Send = (type, fields) => sides.forEach((side) => side.live.send(type, fields));
  const ended = sides.every((side) => side.ended);
  const isPlaying = beside ? wantsPlay && !ended : (live.header?.playing ?? wantsPlay);
  together.play(sides, Boolean(beside) && isPlaying, fps);
  useEffect(() => {
    if (beside && ended) setWantsPlay(false);
  }, [Boolean(beside) && ended]);

  const reset = () => sides.forEach((side) => side.reset());
  const play = (on: boolean) => {
    if (on && ended) reset();
    if (!beside) send("play", { on });
    setWantsPlay(on);
  };
  const change = (to: Change) => {
    if (edited === left) patch(to);
    else patch({ beside: inBeside({ ...besideParams, ...to } as Params) });
  };
  const next = () => patch({ seed: String(seed + 1) });
  const randomise = () => {
    change({ variation: "all", pin: undefined });
    next();
  };
  const act = (action: number[]) => {
    setHand(action);
    send("act", { action });
    if (by !== "hand") patch({ by: "hand" });
  };
  useLoop(loop && ended && !live.recording?.dataset, () => {
    next();
    play(true);
  });
  const start = () => !isPlaying && !ended && play(true);
  useTakeOver(info, act, start);
  const copy = () => void navigator.clipboard?.writeText(edited.live.started?.command ?? "");
  useKeys({
    " ": () => play(!isPlaying),
    ".": () => send("step"),
    r: reset,
    n: next,
    v: randomise,
    c: copy,
    k: () => live.send("keep"),
    d: () => live.send("discard"),
  });
  const point = (at: [number, number] | undefined) => {
    if (!isPointed(info.id) || !live.header) return;
    const wasPointed = pointed.current;
    pointed.current = at;
    if (at) act(towards(at, live.header.state));
    else if (wasPointed) act(atRest(info.action));
    if (at) start();
  };
  return { ...left, beside, edited, hand, isPlaying, ended, send, play, reset, next, randomise, change, act, copy, point };
}

// Steps two sides together: the next step is asked for when both have shown the last one. One that has ended waits for the other.
function useTogether() {
  const headers = useRef<(Header | undefined)[]>([]);
  const sides = useRef<Side[]>([]);
  const asked = useRef(0);
  const interval = useRef(0);
  const isOn = useRef(false);
  const timer = useRef(0);
  const step = () => {
    timer.current = 0;
    if (!isOn.current) return;
    asked.current = performance.now();
    sides.current.forEach((side, i) => !hasEnded(headers.current[i]) && side.live.send("step"));
  };
  const go = () => {
    const open = headers.current.filter((header) => header && !hasEnded(header));
    const isBehind = new Set(open.map((header) => header?.step)).size > 1;
    if (!isOn.current || timer.current || open.length === 0 || isBehind) return;
    timer.current = setTimeout(step, Math.max(0, asked.current + interval.current - performance.now()));
  };
  useEffect(() => () => clearTimeout(timer.current), []);
  return {
    arrived: (side: number, header: Header) => {
      headers.current[side] = header;
      if (sides.current.length > 1) go();
    },
    play: (of: Side[], on: boolean, fps: number) => {
      const begins = on && !isOn.current;
      [sides.current, isOn.current, interval.current] = [of, on, 1000 / fps];
      if (begins) go();
    },
  };
}

// Starts the next episode a moment after one has ended.
function useLoop(isDue: boolean, start: () => void): void {
  const current = useRef(start);
  current.current = start;
  useEffect(() => {
    if (!isDue) return;
    const timer = setTimeout(() => current.current(), PAUSE);
    return () => clearTimeout(timer);
  }, [isDue]);
}

// Arrow keys and gamepads act, and start the episode.
function useTakeOver(info: EnvInfo, act: (action: number[]) => void, start: () => void): void {
  const held = useRef(new Set<string>());
  const rest = useMemo(() => atRest(info.action), [info]);
  useArrows((key, down) => {
    if (down) held.current.add(key);
    else held.current.delete(key);
    act(ofArrows(info.action, held.current, rest));
    if (down) start();
  });
  useGamepad(info.action, rest, (action, isAtRest) => {
    act(action);
    if (!isAtRest) start();
  });
}
