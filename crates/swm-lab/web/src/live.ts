// The hook of a live environment: connects when the environment or the size changes, and draws frames into a canvas.

import { type RefObject } from "preact";
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { connect, type Header, type Recording, type Send, type Session, type Started } from "./session";

export interface Live {
  header?: Header;
  started?: Started;
  recording?: Recording;
  error?: string;
  isClosed: boolean;
  fps: number;
  send: Send;
  reconnect: () => void;
  dismiss: () => void;
}

const NONE = { header: undefined, started: undefined, recording: undefined, error: undefined, isClosed: false, fps: 0 };
// How often the page shows the values of frames, in milliseconds; frames themselves are drawn as they come.
const REFRESH = 80;

export function useLive(
  env: string,
  side: number,
  canvas: RefObject<HTMLCanvasElement | null>,
  onHeader: (header: Header) => void,
): Live {
  const [state, setState] = useState<Omit<Live, "send" | "reconnect" | "dismiss">>(NONE);
  const [attempt, setAttempt] = useState(0);
  const session = useRef<Session | undefined>(undefined);
  const listener = useRef(onHeader);
  listener.current = onHeader;
  useEffect(() => {
    setState(NONE);
    if (!env) return;
    const times: number[] = [];
    let last: Header | undefined;
    let lastShown = 0;
    let timer = 0;
    const publish = () => {
      timer = 0;
      lastShown = performance.now();
      while (times.length > 0 && times[0] < lastShown - 1000) times.shift();
      setState((old) => ({ ...old, header: last, fps: times.length }));
    };
    session.current = connect(env, side, {
      frame: (header, image) => {
        const to = canvas.current;
        if (to) {
          if (to.width !== image.width) to.width = image.width;
          if (to.height !== image.height) to.height = image.height;
          to.getContext("2d")?.drawImage(image, 0, 0);
        }
        times.push(performance.now());
        last = header;
        listener.current(header);
        if (performance.now() - lastShown > REFRESH) publish();
        else if (!timer) timer = setTimeout(publish, REFRESH);
      },
      started: (started) => setState((old) => ({ ...old, started, error: undefined })),
      recording: (recording) => setState((old) => ({ ...old, recording })),
      failed: (error) => setState((old) => ({ ...old, error })),
      closed: () => setState((old) => ({ ...old, isClosed: true })),
    });
    return () => {
      clearTimeout(timer);
      session.current?.close();
    };
  }, [env, side, attempt]);
  const send: Send = useCallback((type, fields) => session.current?.send(type, fields), []);
  const reconnect = useCallback(() => setAttempt((n) => n + 1), []);
  const dismiss = useCallback(() => setState((old) => ({ ...old, error: undefined })), []);
  return { ...state, send, reconnect, dismiss };
}
