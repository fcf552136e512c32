// Controls for every factor of variation, made from its space.

import type { Factor } from "./api";
import { short } from "./format";
import { bounds, fromHex, isInteger, size, toHex } from "./variation";

// Choices with at most this many values are buttons.
const MOST_BUTTONS = 8;
// Values with more elements than this have no controls.
const MOST_ELEMENTS = 8;

interface Props {
  factor: Factor;
  value: number[];
  pinned: boolean;
  sampled: boolean;
  onPin: (value: number[] | undefined) => void;
  onSample: (on: boolean) => void;
}

export function FactorRow({ factor, value, pinned, sampled, onPin, onSample }: Props) {
  const name = factor.key.split(".").slice(1).join(".") || factor.key;
  const isDefault = value.every((v, i) => v === factor.default[i]);
  return (
    <div class={`factor ${pinned ? "is-pinned" : ""}`} role="group" aria-label={factor.key}>
      <div class="factor-name">
        <span title={`default: ${factor.default.map(short).join(", ")}`}>{name}</span>
        <span class="factor-state">
          {!pinned && !sampled && !isDefault && <span class="muted">set</span>}
          <button
            type="button"
            class="chip"
            aria-pressed={sampled && !pinned}
            title="Sample at every reset"
            onClick={() => onSample(!(sampled && !pinned))}
          >
            sample
          </button>
          <button
            type="button"
            class="chip"
            aria-pressed={pinned}
            title={pinned ? "Back to the default" : "Keep this value"}
            onClick={() => onPin(pinned ? undefined : value)}
          >
            pin
          </button>
        </span>
      </div>
      <Control factor={factor} value={value} onChange={onPin} />
    </div>
  );
}

export function Control({ factor, value, onChange }: { factor: Factor; value: number[]; onChange: (v: number[]) => void }) {
  const { space, key } = factor;
  if (space.type === "RGBBox") {
    return (
      <div class="control">
        <input
          type="color"
          aria-label={key}
          value={toHex(value)}
          onInput={(event) => onChange(fromHex(event.currentTarget.value))}
        />
        <code class="muted">{value.join(", ")}</code>
      </div>
    );
  }
  const [low, high] = bounds(space, 0);
  if (space.type === "Discrete" && high !== null && low !== null && high - low < MOST_BUTTONS) {
    const values = Array.from({ length: high - low + 1 }, (_, i) => low + i);
    return (
      <div class="control segments" role="radiogroup" aria-label={key}>
        {values.map((option) => (
          <button
            type="button"
            role="radio"
            aria-checked={value[0] === option}
            key={option}
            onClick={() => onChange([option])}
          >
            {option}
          </button>
        ))}
      </div>
    );
  }
  if (size(space) > MOST_ELEMENTS) return <div class="muted">{size(space)} elements: no controls</div>;
  return (
    <>
      {value.map((element, i) => (
        <Slider
          key={i}
          label={value.length > 1 ? `${key}[${i}]` : key}
          value={element}
          range={bounds(space, i)}
          integer={isInteger(space)}
          onChange={(changed) => onChange(value.map((v, j) => (i === j ? changed : v)))}
        />
      ))}
    </>
  );
}

interface SliderProps {
  label: string;
  value: number;
  range: [number | null, number | null];
  integer: boolean;
  onChange: (value: number) => void;
}

export function Slider({ label, value, range: [low, high], integer, onChange }: SliderProps) {
  const isBounded = low !== null && high !== null;
  const step = integer ? 1 : isBounded ? Math.max((high - low) / 500, 1e-9) : 0.01;
  const changed = (text: string) => {
    const number = Number(text);
    if (text === "" || !Number.isFinite(number)) return;
    onChange(Math.min(high ?? number, Math.max(low ?? number, number)));
  };
  return (
    <div class="control">
      {isBounded && (
        <input
          type="range"
          aria-label={label}
          min={low}
          max={high}
          step={step}
          value={value}
          onInput={(event) => changed(event.currentTarget.value)}
        />
      )}
      <input
        type="number"
        class="value"
        aria-label={`${label}, value`}
        min={low ?? undefined}
        max={high ?? undefined}
        step={integer ? 1 : "any"}
        value={short(value)}
        title={isBounded ? `${short(low)} to ${short(high)}` : "any value"}
        onChange={(event) => changed(event.currentTarget.value)}
      />
    </div>
  );
}
