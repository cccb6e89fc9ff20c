/** Episodes of a session: changes of the list, and saving it without overwriting the changes of another person. */
import { signal, type ReadonlySignal } from "@preact/signals-core";
import { ApiError, sentence } from "../../../../shared/api/http";
import type { Episode, Outcome } from "../../../../shared/api/recordings";
import { clamp } from "../../../../shared/lib/angles";

/** Returns the new ETag; null: the response has none. */
export type SaveEpisodes = (episodes: readonly Episode[], etag: string) => Promise<string | null>;

/** The shortest episode [s]. */
export const SHORTEST_S = 0.1;
const PRECONDITION_FAILED = 412;

export type EpisodeList = readonly Episode[];

/** Index of the episode that contains a time, at a common end the later one; -1: none. */
export function episodeAt(episodes: EpisodeList, at_s: number): number {
  return episodes.findLastIndex(({ start_s, end_s }) => start_s <= at_s && at_s <= end_s);
}

/** Sets the outcome of the episode at a time, or removes it if it is the same. Without an episode, adds one in the free time around. */
export function rated(episodes: EpisodeList, at_s: number, outcome: Outcome, duration_s: number): EpisodeList {
  const index = episodeAt(episodes, at_s);
  const found = episodes[index];
  if (found !== undefined) return changed(episodes, index, { outcome: found.outcome === outcome ? null : outcome });
  const start_s = Math.max(0, ...episodes.map(({ end_s }) => end_s).filter((end) => end <= at_s));
  const end_s = Math.min(duration_s, ...episodes.map((one) => one.start_s).filter((start) => start >= at_s));
  if (end_s - start_s < SHORTEST_S) return episodes;
  return [...episodes, { start_s, end_s, outcome, label: "", note: "" }].sort((one, other) => one.start_s - other.start_s);
}

export function changed(episodes: EpisodeList, index: number, change: Partial<Episode>): EpisodeList {
  return episodes.map((one, at) => (at === index ? { ...one, ...change } : one));
}

/** Moves an end of an episode, at most to its neighbour and to its other end. */
export function trimmed(episodes: EpisodeList, index: number, end: "start_s" | "end_s", to_s: number, duration_s: number): EpisodeList {
  const episode = episodes[index];
  if (episode === undefined) return episodes;
  const [lower, upper] =
    end === "start_s"
      ? [episodes[index - 1]?.end_s ?? 0, episode.end_s - SHORTEST_S]
      : [episode.start_s + SHORTEST_S, episodes[index + 1]?.start_s ?? duration_s];
  return changed(episodes, index, { [end]: clamp(to_s, lower, Math.max(lower, upper)) });
}

/** Splits the episode at a time; both parts keep outcome, label and note. Too short parts are not created. */
export function split(episodes: EpisodeList, at_s: number): EpisodeList {
  const index = episodeAt(episodes, at_s);
  const found = episodes[index];
  if (found === undefined || at_s - found.start_s < SHORTEST_S || found.end_s - at_s < SHORTEST_S) return episodes;
  return [...episodes.slice(0, index), { ...found, end_s: at_s }, { ...found, start_s: at_s }, ...episodes.slice(index + 1)];
}

export function removed(episodes: EpisodeList, index: number): EpisodeList {
  return episodes.filter((_, at) => at !== index);
}

/** `conflict`: another person changed the list, so the changes of this page were replaced by the stored list. */
export type SaveState = { kind: "saved" | "saving" | "conflict" } | { kind: "failed"; reason: string };

export class Episodes {
  readonly #save: SaveEpisodes;
  readonly #reload: () => Promise<void>;
  readonly #list = signal<EpisodeList>([]);
  readonly #state = signal<SaveState>({ kind: "saved" });
  #etag: string | null = null;
  /** Whether the list has changes that are not stored. */
  #unsaved = false;
  #saving = false;

  /** In order of time, without overlap. */
  readonly list: ReadonlySignal<EpisodeList> = this.#list;
  readonly state: ReadonlySignal<SaveState> = this.#state;

  /** `reload` reads the stored list and passes it to `adopt`. */
  constructor(save: SaveEpisodes, reload: () => Promise<void>) {
    this.#save = save;
    this.#reload = reload;
  }

  /** Takes over the stored list, unless this page has changes. */
  adopt(stored: EpisodeList, etag: string | null): void {
    if (this.#unsaved) return;
    this.#etag = etag;
    this.#list.value = stored.toSorted((one, other) => one.start_s - other.start_s);
  }

  /** Changes the list on this page only, as during a drag. `commit` must follow. */
  preview(list: EpisodeList): void {
    if (list === this.#list.value) return;
    this.#unsaved = true;
    this.#list.value = list;
  }

  /** Changes the list and saves it. Changes during a save are saved after it. */
  async commit(list: EpisodeList = this.#list.value): Promise<void> {
    this.preview(list);
    if (!this.#unsaved || this.#saving) return;
    this.#saving = true;
    this.#state.value = { kind: "saving" };
    try {
      let saved = false;
      while (!saved) saved = await this.#saveOnce();
      this.#state.value = { kind: "saved" };
    } catch (error) {
      this.#state.value = await this.#rejected(error);
    }
    this.#saving = false;
  }

  /** Whether the list is stored; false: it changed meanwhile. */
  async #saveOnce(): Promise<boolean> {
    const list = this.#list.value;
    if (this.#etag === null) throw new Error("The version of the stored episodes is unknown. Reload the page.");
    this.#etag = await this.#save(list, this.#etag);
    if (this.#list.value !== list) return false;
    this.#unsaved = false;
    // Without an ETag in the response, the next save needs the current one.
    if (this.#etag === null) await this.#reload();
    return true;
  }

  async #rejected(error: unknown): Promise<SaveState> {
    if (!(error instanceof ApiError) || error.status !== PRECONDITION_FAILED) return { kind: "failed", reason: sentence(error) };
    this.#unsaved = false;
    try {
      await this.#reload();
      return { kind: "conflict" };
    } catch (reloadError) {
      return { kind: "failed", reason: sentence(reloadError) };
    }
  }
}
