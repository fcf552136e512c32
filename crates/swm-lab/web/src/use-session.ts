// The hook of a session: connects when the environment or the size changes, draws frames into a canvas, and shows what has arrived
// at most so often.

import type { RefObject } from "preact";
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { open, type Reply, type Send, type Session } from "./session";

// What the state of every session has.
export interface Connected {
  error?: string;
  isClosed: boolean;
}

export interface Actions {
  send: Send;
  reconnect: () => void;
  dismiss: () => void;
}

export interface Events<H, S> {
  // The state after a frame, and after a reply.
  frame: (state: S, header: H) => S;
  reply: (state: S, reply: Reply) => S;
  // Is called at once for every frame.
  arrived?: (header: H) => void;
}

// How often the page shows what arrived, in milliseconds; frames themselves are drawn as they come.
const REFRESH = 60;

// An empty `env` connects to nothing.
export function useSession<H, S extends Connected>(
  route: string,
  env: string,
  side: number,
  canvas: RefObject<HTMLCanvasElement | null>,
  none: S,
  events: Events<H, S>,
): S & Actions {
  const [state, setState] = useState(none);
  const [attempt, setAttempt] = useState(0);
  const session = useRef<Session | undefined>(undefined);
  const now = useRef(none);
  const listener = useRef(events);
  listener.current = events;
  useEffect(() => {
    let timer = 0;
    const change = (next: S) => {
      now.current = next;
      timer ||= setTimeout(() => {
        timer = 0;
        setState(now.current);
      }, REFRESH);
    };
    now.current = none;
    setState(none);
    if (!env) return;
    session.current = open<H>(route, env, side, {
      frame: (header, image) => {
        draw(canvas.current, image);
        listener.current.arrived?.(header);
        change(listener.current.frame(now.current, header));
      },
      reply: (reply) => {
        const next = listener.current.reply(now.current, reply);
        change(reply.type === "failed" ? { ...next, error: String(reply.message) } : next);
      },
      closed: () => change({ ...now.current, isClosed: true }),
    });
    return () => {
      clearTimeout(timer);
      session.current?.close();
      session.current = undefined;
    };
  }, [route, env, side, attempt]);
  const send: Send = useCallback((type, fields) => session.current?.send(type, fields), []);
  const reconnect = useCallback(() => setAttempt((n) => n + 1), []);
  const dismiss = useCallback(() => {
    now.current = { ...now.current, error: undefined };
    setState(now.current);
  }, []);
  return { ...state, send, reconnect, dismiss };
}

function draw(to: HTMLCanvasElement | null, image: ImageBitmap): void {
  if (!to) return;
  if (to.width !== image.width) to.width = image.width;
  if (to.height !== image.height) to.height = image.height;
  to.getContext("2d")?.drawImage(image, 0, 0);
}
