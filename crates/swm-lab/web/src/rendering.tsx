// What is shown of an environment: its camera and what that renders, and the stack of wrappers that change its frames.

import { useState } from "preact/hooks";
import { type EnvInfo, get, type Wrapper } from "./api";
import { useLoaded } from "./state";
import { Choice } from "./transport";

export interface Rendering {
  // `CAMERA`, `depth`, `segmentation` or `CAMERA:depth`; undefined for the colour of the default camera.
  view?: string;
  // Wrappers in the form of the command line.
  wrappers: string[];
  wrapGoal: boolean;
}

const MODALITIES = ["colour", "depth", "segmentation"];

// The camera and the modality of a view.
function parseView(view: string | undefined, cameras: string[]): [string, string] {
  if (!view) return [cameras[0], MODALITIES[0]];
  if (MODALITIES.includes(view)) return [cameras[0], view];
  const [camera, modality = MODALITIES[0]] = view.split(":");
  return [camera, modality];
}

function formatView(camera: string, modality: string, cameras: string[]): string | undefined {
  const parts = [camera === cameras[0] ? "" : camera, modality === MODALITIES[0] ? "" : modality].filter(Boolean);
  return parts.join(":") || undefined;
}

export function Views({ info, view, onView }: { info: EnvInfo; view?: string; onView: (view?: string) => void }) {
  const { cameras } = info;
  if (cameras.length === 0) return null;
  const [camera, modality] = parseView(view, cameras);
  return (
    <>
      {cameras.length > 1 && (
        <Choice
          label="camera"
          value={camera}
          options={cameras}
          onChange={(to) => onView(formatView(to, modality, cameras))}
        />
      )}
      <Choice
        label="shows"
        value={modality}
        options={MODALITIES}
        onChange={(to) => onView(formatView(camera, to, cameras))}
      />
    </>
  );
}

interface WrappersProps {
  rendering: Rendering;
  onChange: (wrappers: string[], wrapGoal: boolean) => void;
}

// The stack of wrappers. Dragging, or the arrows of a wrapper, change the order.
export function Wrappers({ rendering: { view, wrappers, wrapGoal }, onChange }: WrappersProps) {
  const { value: all = [] } = useLoaded(() => get<Wrapper[]>("wrappers"), "wrappers");
  const [dragged, setDragged] = useState<number>();
  const [isOpen, setOpen] = useState(wrappers.length > 0);
  const change = (next: string[]) => onChange(next, wrapGoal);
  const move = (from: number, to: number) => {
    if (from === to || to < 0 || to >= wrappers.length) return;
    const next = [...wrappers];
    next.splice(to, 0, ...next.splice(from, 1));
    change(next);
  };
  return (
    <details class="panel wrappers" open={isOpen} onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>
        Wrappers{" "}
        <small class="muted">
          {view ? "change the colour of the default camera only" : wrappers.length > 0 ? "from the top to the bottom" : "change the frames"}
        </small>
      </summary>
      <ol>
        {wrappers.map((text, i) => {
          const [id, ...given] = text.split(",");
          return (
            <li
              key={`${i} ${id}`}
              class={dragged === i ? "is-dragged" : ""}
              onDragOver={(event) => event.preventDefault()}
              onDrop={(event) => {
                event.preventDefault();
                if (dragged !== undefined) move(dragged, i);
                setDragged(undefined);
              }}
            >
              <span
                class="handle"
                draggable
                title="Drag to another place"
                aria-hidden="true"
                onDragStart={(event) => {
                  event.dataTransfer?.setData("text/plain", id);
                  setDragged(i);
                }}
                onDragEnd={() => setDragged(undefined)}
              >
                ⠿
              </span>
              <b title={all.find((one) => one.id === id)?.summary}>{id}</b>
              <span class="settings">
                {Object.entries(all.find((one) => one.id === id)?.parameters ?? {}).map(([name, parameter]) => (
                  <label key={name} title={`${parameter.summary}: ${parameter.allowed}`}>
                    {name}
                    <input
                      type="text"
                      class="value"
                      aria-label={`${id} ${name}`}
                      placeholder={inWords(parameter.default)}
                      value={settingOf(given, name)}
                      onChange={(event) => change(wrappers.map((old, j) => (i === j ? withSetting(old, name, event.currentTarget.value) : old)))}
                    />
                  </label>
                ))}
              </span>
              <span class="order">
                <button type="button" class="quiet" aria-label={`Move ${id} up`} disabled={i === 0} onClick={() => move(i, i - 1)}>
                  ↑
                </button>
                <button
                  type="button"
                  class="quiet"
                  aria-label={`Move ${id} down`}
                  disabled={i === wrappers.length - 1}
                  onClick={() => move(i, i + 1)}
                >
                  ↓
                </button>
                <button type="button" class="quiet" aria-label={`Remove ${id}`} onClick={() => change(wrappers.filter((_, j) => j !== i))}>
                  ×
                </button>
              </span>
            </li>
          );
        })}
      </ol>
      <div class="bar">
        <select
          aria-label="Add a wrapper"
          value=""
          disabled={Boolean(view)}
          onChange={(event) => {
            change([...wrappers, event.currentTarget.value]);
            event.currentTarget.value = "";
          }}
        >
          <option value="">add …</option>
          {all.map(({ id, summary }) => (
            <option key={id} value={id} title={summary}>
              {id}
            </option>
          ))}
        </select>
        {wrappers.length > 0 && (
          <label>
            <input type="checkbox" checked={wrapGoal} onChange={(event) => onChange(wrappers, event.currentTarget.checked)} />
            the goal, too
          </label>
        )}
      </div>
    </details>
  );
}

// A setting in the form of the command line.
function inWords(value: unknown): string {
  return Array.isArray(value) ? value.map(inWords).join("/") : String(value ?? "");
}

function settingOf(given: string[], name: string): string {
  return given.find((setting) => setting.startsWith(`${name}=`))?.slice(name.length + 1) ?? "";
}

// Sets a parameter of a wrapper; an empty value is the default. Characters that end a setting are left out.
function withSetting(text: string, name: string, value: string): string {
  const [id, ...given] = text.split(",");
  const others = given.filter((setting) => !setting.startsWith(`${name}=`));
  const clean = value.replace(/[,;=\s]/g, "");
  return [id, ...others, ...(clean ? [`${name}=${clean}`] : [])].join(",");
}
