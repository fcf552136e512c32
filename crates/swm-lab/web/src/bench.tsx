// The page that `swm bench lab` opens: it measures frames and latency in the browser, and sends what it measured.

import { useEffect, useRef, useState } from "preact/hooks";
import { type EnvInfo, get, post } from "./api";
import { type Header, open, type Send } from "./session";
import type { Params } from "./state";

// Steps whose latency is measured.
const STEPS = 41;
// Steps a second that are asked for.
const FPS = 120;
// The time before frames are counted, in milliseconds.
const WARM = 1000;

interface Measured {
  env: string;
  load: number;
  sent: number;
  presented: number;
  latency: number;
}

export function BenchPage({ params }: { params: Params }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const [text, setText] = useState("measuring …");
  useEffect(() => {
    const measured = measure(params.env, Number(params.image) || 224, Number(params.seconds) || 5, canvas.current);
    measured.then(
      (found) => {
        setText(JSON.stringify(found));
        return post("bench", found);
      },
      (error) => post("bench", { env: params.env, error: String(error.message ?? error) }),
    );
  }, []);
  return (
    <div>
      <canvas ref={canvas} width={224} height={224} />
      <code>{text}</code>
    </div>
  );
}

async function measure(env: string, side: number, seconds: number, canvas: HTMLCanvasElement | null): Promise<Measured> {
  const info = await get<EnvInfo>("env", { env });
  let arrived = 0;
  const presented = new Set<number>();
  let onFrame: (header: Header) => void = () => undefined;
  let send: Send = () => undefined;
  await new Promise<void>((ready, fail) => {
    const session = open<Header>("live", env, side, {
      arrived: () => {
        arrived += 1;
      },
      frame: (header, image) => {
        canvas?.getContext("2d")?.drawImage(image, 0, 0, 224, 224);
        // Two frames that are drawn before the screen is are one.
        presented.add(document.timeline.currentTime as number);
        onFrame(header);
      },
      reply: (reply) => {
        if (reply.type === "started") ready();
        if (reply.type === "failed") fail(new Error(String(reply.message)));
      },
      closed: () => fail(new Error("the lab closed the connection")),
    });
    send = session.send;
  });
  let seed = 0;
  send("drive", { by: info.experts[0]?.id ?? "random" });
  send("speed", { fps: FPS });
  onFrame = (header) => {
    if (!header.terminated && !header.truncated) return;
    seed += 1;
    send("reset", { seed });
    send("play", { on: true });
  };
  send("play", { on: true });
  await sleep(WARM);
  arrived = 0;
  presented.clear();
  const begun = performance.now();
  await sleep(1000 * seconds);
  const elapsed = (performance.now() - begun) / 1000;
  const [sent, shown] = [arrived / elapsed, presented.size / elapsed];
  send("play", { on: false });
  await sleep(300);
  return { env, load: loaded(), sent, presented: shown, latency: await latency(send, (call) => (onFrame = call)) };
}

// The median time from a request for a step to the frame of the step on its way to the screen, in milliseconds.
async function latency(send: Send, listen: (call: (header: Header) => void) => void): Promise<number> {
  // The hand does nothing, so that no episode ends.
  send("drive", { by: "hand" });
  send("reset", { seed: 1 });
  await sleep(300);
  const times: number[] = [];
  for (let i = 1; i <= STEPS; i++) {
    // Requests come at any time between two refreshes of the screen.
    await sleep(20 + 17 * Math.random());
    const begun = performance.now();
    send("step");
    await new Promise<void>((shown) => listen((header) => header.step === i && shown()));
    times.push(performance.now() - begun);
  }
  return times.sort((a, b) => a - b)[Math.floor(STEPS / 2)];
}

const sleep = (milliseconds: number) => new Promise((done) => setTimeout(done, milliseconds));

function loaded(): number {
  const [navigation] = performance.getEntriesByType("navigation") as PerformanceNavigationTiming[];
  return navigation?.loadEventEnd ?? 0;
}
