// What is wrong with a dataset, which of its episodes are cut, and a new dataset of the others.

import { useState } from "preact/hooks";
import { type Dataset, type Diagnosis, get, post } from "./api";
import { count } from "./format";

// Episodes of a finding that have a button.
const SHOWN = 12;

interface Props {
  set: Dataset;
  cut: Set<number>;
  // The number of episodes; 0 for a dataset that does not open.
  count: number;
  onCut: (positions: Set<number>) => void;
  // The key of the table of episodes.
  tableKey?: string;
  onSaved: () => void;
  onChoose?: (position: number) => void;
}

export function Curation({ set, cut, count: all, tableKey, onCut, onSaved, onChoose }: Props) {
  const [diagnosis, setDiagnosis] = useState<Diagnosis>();
  const [message, setMessage] = useState<string>();
  const [isBusy, setBusy] = useState(false);
  const [target, setTarget] = useState(() => `${set.name.split(".")[0].replace(/[^A-Za-z0-9_-]/g, "-")}-cut`);
  const work = async (call: () => Promise<string | undefined>) => {
    setBusy(true);
    setMessage(undefined);
    try {
      setMessage(await call());
    } catch (error) {
      setMessage(error instanceof Error ? error.message : String(error));
    }
    setBusy(false);
  };
  const examine = () =>
    work(async () => {
      setDiagnosis(await get<Diagnosis>("doctor", { folder: set.folder, name: set.name }));
      return undefined;
    });
  const positions = all > 0 ? Array.from({ length: all }, (_, i) => i) : (diagnosis?.sound ?? []);
  const kept = positions.filter((position) => !cut.has(position));
  const save = () =>
    work(async () => {
      const body = { folder: set.folder, name: set.name, target, episodes: kept, key: tableKey ?? null };
      const saved = await post<{ episodes: number }>("save", body);
      onSaved();
      return `${count(saved.episodes)} episodes are in ${target}.lance`;
    });
  const problems = diagnosis?.findings.filter((finding) => finding.severity === "problem") ?? [];
  const bad = problems.flatMap((finding) => finding.episodes);
  return (
    <div class="panel curation">
      <div class="bar">
        <button type="button" onClick={examine} disabled={isBusy} title="As swm doctor does">
          Examine
        </button>
        {diagnosis && problems.length === 0 && <span class="success-yes">no problems</span>}
        {bad.length > 0 && all > 0 && (
          <button type="button" onClick={() => onCut(new Set([...cut, ...bad]))}>
            Cut all with problems
          </button>
        )}
        {cut.size > 0 && (
          <button type="button" onClick={() => onCut(new Set())}>
            Cut none
          </button>
        )}
      </div>
      {diagnosis && <Findings diagnosis={diagnosis} onChoose={onChoose} />}
      {(cut.size > 0 || (all === 0 && kept.length > 0)) && (
        <form
          class="bar"
          onSubmit={(event) => {
            event.preventDefault();
            void save();
          }}
        >
          <label class="grow">
            Save {count(kept.length)} episodes as
            <input
              type="text"
              aria-label="Name of the new dataset"
              value={target}
              pattern="[A-Za-z0-9_][A-Za-z0-9_\-]*"
              maxLength={64}
              required
              onInput={(event) => setTarget(event.currentTarget.value)}
            />
          </label>
          <button type="submit" disabled={isBusy || kept.length === 0}>
            Save
          </button>
        </form>
      )}
      {message && <p role="status">{message}</p>}
    </div>
  );
}

function Findings({ diagnosis, onChoose }: { diagnosis: Diagnosis; onChoose?: (position: number) => void }) {
  return (
    <ul class="findings">
      {diagnosis.findings.map((finding) => (
        <li key={finding.what}>
          <span class={finding.severity}>{finding.severity}:</span> {finding.what}{" "}
          {onChoose &&
            finding.episodes.slice(0, SHOWN).map((position) => (
              <button type="button" class="chip" key={position} onClick={() => onChoose(position)}>
                {position}
              </button>
            ))}
          {finding.episodes.length > SHOWN && <small> and {finding.episodes.length - SHOWN} more</small>}
        </li>
      ))}
    </ul>
  );
}
