// Driving with a gamepad of the standard layout: the sticks are the first four elements of an action, the cross is the arrow keys.

import { useEffect, useRef } from "preact/hooks";
import type { Space } from "./api";
import { ofArrows } from "./hand";
import { bounds, size } from "./variation";

// Sticks that are nearly at rest are at rest.
const DEAD = 0.15;
// A stick that is held further than this chooses a discrete action.
const HELD = 0.5;
// The buttons of the cross.
const CROSS = ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight"];
const FIRST_OF_CROSS = 12;
// How often a gamepad is looked for, in milliseconds.
const LOOK = 500;

export interface Pad {
  axes: readonly number[];
  buttons: readonly { pressed: boolean }[];
}

// The action of a gamepad.
export function ofPad(space: Space, pad: Pad, rest: number[]): number[] {
  const held = new Set(CROSS.filter((_, i) => pad.buttons[FIRST_OF_CROSS + i]?.pressed));
  const [x = 0, y = 0] = pad.axes;
  if (space.type !== "Box") {
    if (Math.abs(x) > HELD) held.add(x < 0 ? "ArrowLeft" : "ArrowRight");
    if (Math.abs(y) > HELD) held.add(y < 0 ? "ArrowUp" : "ArrowDown");
    return ofArrows(space, held, rest);
  }
  const action = ofArrows(space, held, rest);
  for (let i = 0; i < Math.min(size(space), 4); i++) {
    const tilt = pad.axes[i] ?? 0;
    if (Math.abs(tilt) < DEAD) continue;
    const [low, high] = bounds(space, i);
    // From rest to the bound on this side.
    const bound = tilt < 0 ? (low ?? rest[i] - 1) : (high ?? rest[i] + 1);
    action[i] = rest[i] + Math.min(1, Math.abs(tilt)) * (bound - rest[i]);
  }
  return action;
}

// Calls `changed` with the action of a gamepad whenever it changes.
export function useGamepad(space: Space, rest: number[], changed: (action: number[], isAtRest: boolean) => void): void {
  const current = useRef(changed);
  current.current = changed;
  useEffect(() => {
    const found = () => navigator.getGamepads?.().find((pad) => pad?.connected) ?? undefined;
    let last = JSON.stringify(rest);
    let frame = 0;
    const poll = () => {
      const pad = found();
      frame = pad ? requestAnimationFrame(poll) : 0;
      const action = pad ? ofPad(space, pad, rest) : rest;
      const text = JSON.stringify(action);
      if (text === last) return;
      last = text;
      current.current(action, text === JSON.stringify(rest));
    };
    const timer = setInterval(() => {
      if (!frame && found()) poll();
    }, LOOK);
    return () => {
      clearInterval(timer);
      cancelAnimationFrame(frame);
    };
  }, [space]);
}
