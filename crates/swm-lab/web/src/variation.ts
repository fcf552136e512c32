// Pinned and sampled factors, in the form of the URL and of the server.

import type { Factor, Space } from "./api";

export type Pins = Record<string, number[]>;

export function parsePins(text: string): Pins {
  const pins: Pins = {};
  for (const pin of text.split(";").filter(Boolean)) {
    const [key, values = ""] = pin.split("=");
    pins[key] = values.split(",").map(Number);
  }
  return pins;
}

export function formatPins(pins: Pins): string {
  return Object.entries(pins)
    .map(([key, values]) => `${key}=${values.join(",")}`)
    .join(";");
}

export function bounds(space: Space, i: number): [number | null, number | null] {
  switch (space.type) {
    case "RGBBox":
      return [0, 255];
    case "Discrete":
      return [space.start as number, (space.start as number) + (space.n as number) - 1];
    case "MultiDiscrete": {
      const first = (space.start as number[])[i];
      return [first, first + (space.nvec as number[])[i] - 1];
    }
    default:
      return [space.low?.[i] ?? null, space.high?.[i] ?? null];
  }
}

export function isInteger(space: Space): boolean {
  return space.type !== "Box" || !(space.dtype ?? "").startsWith("float");
}

export function size(space: Space): number {
  if (space.type === "RGBBox") return 3;
  if (space.type === "Discrete") return 1;
  if (space.type === "MultiDiscrete") return space.nvec?.length ?? 0;
  return space.low?.length ?? 0;
}

// The factors that a value of the parameter `variation` samples; groups and `all` name several.
export function sampledKeys(factors: Factor[], variation: string | undefined): Set<string> {
  if (variation === undefined) return new Set(factors.filter((factor) => factor.sampled).map((factor) => factor.key));
  const named = variation.split(",");
  const is = (key: string) => named.some((name) => name === "all" || key === name || key.startsWith(`${name}.`));
  return new Set(factors.filter((factor) => is(factor.key)).map((factor) => factor.key));
}

// The shortest value of `variation` that samples these factors; undefined for the environment's defaults.
export function formatSampled(factors: Factor[], keys: Set<string>): string | undefined {
  const isDefault = factors.every((factor) => factor.sampled === keys.has(factor.key));
  if (isDefault) return undefined;
  if (keys.size === 0) return "none";
  return factors.every((factor) => keys.has(factor.key)) ? "all" : [...keys].join(",");
}

export function toHex(rgb: number[]): string {
  return `#${rgb.map((value) => Math.round(value).toString(16).padStart(2, "0")).join("")}`;
}

export function fromHex(hex: string): number[] {
  return [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
}
