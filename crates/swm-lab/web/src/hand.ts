// How a person drives an environment: the pointer on Push-T, arrow keys elsewhere, sliders and buttons for any action.

import { useEffect, useRef } from "preact/hooks";
import type { Space } from "./api";
import { bounds, size } from "./variation";

// Push-T's table is 512 pixels wide, and an action of 1 moves the target by 100 (its README).
const TABLE = 512;
const REACH = 100;

export function isPointed(env: string): boolean {
  return env.startsWith("swm/PushT-v");
}

// The action that moves Push-T's agent towards a point of the frame, in fractions of its sides.
export function towards(point: [number, number], state: number[]): number[] {
  return point.map((part, i) => Math.max(-1, Math.min(1, (part * TABLE - state[i]) / REACH)));
}

const ARROWS: Record<string, [number, number]> = {
  ArrowLeft: [0, -1],
  ArrowRight: [0, 1],
  ArrowUp: [1, -1],
  ArrowDown: [1, 1],
};

export function isArrow(key: string): boolean {
  return key in ARROWS;
}

// The action of the arrow keys that are held. A discrete action has the first choice for left, the last for right.
export function ofArrows(space: Space, held: Set<string>, rest: number[]): number[] {
  const action = [...rest];
  for (const key of held) {
    const [axis, sign] = ARROWS[key] ?? [0, 0];
    const index = Math.min(axis, size(space) - 1);
    const [low, high] = bounds(space, index);
    if (space.type !== "Box") action[index] = (sign < 0 ? low : high) ?? 0;
    else if (axis < size(space)) action[index] = (sign < 0 ? low : high) ?? rest[index] + sign;
  }
  return action;
}

// The action that changes least, as the server has it.
export function atRest(space: Space): number[] {
  return Array.from({ length: size(space) }, (_, i) => {
    const [low, high] = bounds(space, i);
    if (space.type !== "Box") return low ?? 0;
    if ((low ?? 0) <= 0 && (high ?? 0) >= 0) return 0;
    return low !== null && high !== null ? (low + high) / 2 : (low ?? high ?? 0);
  });
}

// Calls `changed` when an arrow key is pressed or released outside of fields.
export function useArrows(changed: (key: string, down: boolean) => void): void {
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
