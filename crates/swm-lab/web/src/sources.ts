// Datasets at URIs: their names are listed by the store, then one after the other is opened, so that the list fills as answers arrive.

import { useEffect, useState } from "preact/hooks";
import { type Dataset, get, type Source } from "./api";

// Datasets of a source that are opened for the list; the others when they are chosen.
const OPENED = 50;

// The datasets of the sources. A store that does not answer has one entry, with the error.
export function useSources(sources: Source[] | undefined): Dataset[] {
  const [found, setFound] = useState<Dataset[][]>([]);
  useEffect(() => {
    let isCurrent = true;
    sources?.forEach((source, index) => {
      const show = (datasets: Dataset[]) =>
        isCurrent && setFound((all) => Object.assign(Array.from({ length: sources.length }, (_, i) => all[i] ?? []), { [index]: datasets }));
      void read(source, show, () => isCurrent);
    });
    return () => {
      isCurrent = false;
    };
  }, [sources]);
  return found.flat();
}

async function read({ folder, location, name }: Source, show: (datasets: Dataset[]) => void, isCurrent: () => boolean) {
  const failed = (error: unknown) => (error instanceof Error ? error.message : String(error));
  let datasets: Dataset[] = name ? [{ folder, name, location }] : [];
  if (!name) {
    try {
      const names = await get<string[]>("names", { folder });
      datasets = names.map((name) => ({ folder, name, location: `${location.replace(/\/$/, "")}/${name}` }));
    } catch (error) {
      return show([{ folder, name: location, location, error: failed(error) }]);
    }
  }
  show(datasets);
  for (const [i, dataset] of datasets.slice(0, OPENED).entries()) {
    if (!isCurrent()) return;
    const summary = await summaryOf(dataset).catch((error) => ({ error: failed(error) }));
    datasets = datasets.with(i, { ...dataset, ...summary });
    show(datasets);
  }
}

// What the list says of a dataset.
export function summaryOf({ folder, name }: Pick<Dataset, "folder" | "name">): Promise<Partial<Dataset>> {
  return get("summary", { folder, name });
}
