// What a page does with a live environment: it keeps the environment in step with the page's address, plays, and takes over.

import type { RefObject } from "preact";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { EnvInfo } from "./api";
import { atRest, isPointed, ofArrows, towards, useArrows } from "./hand";
import { type Live, useLive } from "./live";
import type { Header } from "./session";
import { type Params, patch, useKeys } from "./state";
import { type Pins, parsePins, sampledKeys } from "./variation";

// The time between the end of an episode and the next one, in milliseconds.
const PAUSE = 700;

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
}

export interface Control {
  settings: Settings;
  live: Live;
  hand: number[];
  isPlaying: boolean;
  ended: boolean;
  play: (on: boolean) => void;
  reset: () => void;
  next: () => void;
  randomise: () => void;
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
    }),
    [info, params],
  );
}

export function useControl(info: EnvInfo, params: Params, canvas: RefObject<HTMLCanvasElement | null>): Control {
  const settings = useSettings(info, params);
  const { side, seed, by, fps, loop, pin, variation } = settings;
  const [wantsPlay, setWantsPlay] = useState(false);
  const [hand, setHand] = useState(() => atRest(info.action));
  const pointed = useRef<[number, number] | undefined>(undefined);
  const onHeader = (header: Header) => {
    if (pointed.current) live.send("act", { action: towards(pointed.current, header.state) });
    if (header.terminated || header.truncated) setWantsPlay(false);
  };
  const live = useLive(info.id, side, canvas, onHeader);
  const { header, send } = live;
  const reset = () => send("reset", { seed, pin, variation });
  // A new connection starts from the address; later changes of the address start another episode.
  useEffect(reset, [seed, pin, variation, side, live.isClosed]);
  useEffect(() => send("drive", { by }), [by, side, live.isClosed]);
  useEffect(() => send("speed", { fps }), [fps, side, live.isClosed]);

  const ended = Boolean(header && (header.terminated || header.truncated));
  const isPlaying = header?.playing ?? wantsPlay;
  const play = (on: boolean) => {
    if (on && ended) reset();
    send("play", { on });
    setWantsPlay(on);
  };
  const next = () => patch({ seed: String(seed + 1) });
  const randomise = () => patch({ seed: String(seed + 1), variation: "all", pin: undefined });
  const act = (action: number[]) => {
    setHand(action);
    send("act", { action });
    if (by !== "hand") patch({ by: "hand" });
  };
  useLoop(loop && ended && !live.recording?.dataset, () => {
    next();
    send("play", { on: true });
  });
  useTakeOver(info, act, () => !isPlaying && !ended && play(true));
  const copy = () => void navigator.clipboard?.writeText(live.started?.command ?? "");
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
  const point = (at: [number, number] | undefined) => {
    if (!isPointed(info.id) || !header) return;
    const wasPointed = pointed.current;
    pointed.current = at;
    if (at) act(towards(at, header.state));
    else if (wasPointed) act(atRest(info.action));
    if (at && !isPlaying && !ended) play(true);
  };
  return { settings, live, hand, isPlaying, ended, play, reset, next, randomise, act, copy, point };
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

// Arrow keys act, and start the episode.
function useTakeOver(info: EnvInfo, act: (action: number[]) => void, start: () => void): void {
  const held = useRef(new Set<string>());
  useArrows((key, down) => {
    if (down) held.current.add(key);
    else held.current.delete(key);
    act(ofArrows(info.action, held.current, atRest(info.action)));
    if (down) start();
  });
}
