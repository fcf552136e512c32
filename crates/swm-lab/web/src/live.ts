// The hook of a live environment.

import type { RefObject } from "preact";
import { useRef } from "preact/hooks";
import type { Header, Recording, Started } from "./session";
import { type Actions, type Connected, useSession } from "./use-session";

interface State extends Connected {
  header?: Header;
  started?: Started;
  recording?: Recording;
  fps: number;
}

export type Live = State & Actions;

const NONE: State = { isClosed: false, fps: 0 };

export function useLive(
  env: string,
  side: number,
  canvas: RefObject<HTMLCanvasElement | null>,
  arrived: (header: Header) => void,
): Live {
  // When the frames of the last second were drawn.
  const times = useRef<number[]>([]);
  return useSession<Header, State>("live", env, side, canvas, NONE, {
    arrived,
    frame: (state, header) => {
      const now = performance.now();
      times.current = [...times.current.filter((time) => time > now - 1000), now];
      return { ...state, header, fps: times.current.length };
    },
    reply: (state, reply) => {
      if (reply.type === "started") return { ...state, started: reply as unknown as Started, error: undefined };
      if (reply.type === "recording") return { ...state, recording: reply as unknown as Recording };
      return state;
    },
  });
}
