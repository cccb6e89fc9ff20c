/** A script being edited: its base version, unsaved changes and versions that others saved meanwhile. */
import { computed, signal, type ReadonlySignal } from "@preact/signals-core";
import { ApiError, sentence } from "../../../shared/api/http";
import type { Draft, StoredValue } from "../../../shared/lib/local-storage";
import { MovementChanged, type Library, type Movement, type MovementSource } from "../../../shared/api/movement-library";

type Loading = { kind: "loading" } | { kind: "loaded" } | { kind: "failed"; saveError: string };

/** Another user saved meanwhile; `theirs` is `null` if the movement was deleted. */
interface Conflict {
  theirs: MovementSource | null;
}

export class ScriptDraft {
  readonly robotType: string;
  readonly name: string;
  readonly #library: Library;
  readonly #storedDraft: StoredValue<Draft>;
  readonly #template: string;
  readonly #loading = signal<Loading>({ kind: "loading" });
  readonly #base = signal<MovementSource | null>(null);
  readonly #text = signal("");
  readonly #saving = signal(false);
  readonly #saveError = signal("");
  readonly #conflict = signal<Conflict | null>(null);
  readonly #restored = signal<number | null>(null);
  #basedOn = 0;

  readonly loading: ReadonlySignal<Loading> = this.#loading;
  /** The last saved version known to this page; `null`: none. */
  readonly base: ReadonlySignal<MovementSource | null> = this.#base;
  readonly text: ReadonlySignal<string> = this.#text;
  readonly saving: ReadonlySignal<boolean> = this.#saving;
  /** Why the last save was rejected; empty otherwise. */
  readonly saveError: ReadonlySignal<string> = this.#saveError;
  readonly conflict: ReadonlySignal<Conflict | null> = this.#conflict;
  /** When the restored text was written [ms since 1970]; `null`: not restored. */
  readonly restored: ReadonlySignal<number | null> = this.#restored;
  readonly changed = computed(() => this.#base.value === null || this.#text.value !== this.#base.value.source);

  /** `template`: the initial text of a new movement. */
  constructor(library: Library, robotType: string, name: string, storedDraft: StoredValue<Draft>, template: string) {
    this.#library = library;
    this.robotType = robotType;
    this.name = name;
    this.#storedDraft = storedDraft;
    this.#template = template;
  }

  async load(): Promise<void> {
    this.#loading.value = { kind: "loading" };
    try {
      this.#base.value = await this.#newest();
    } catch (error) {
      this.#loading.value = { kind: "failed", saveError: sentence(error) };
      return;
    }
    const saved = this.#base.value?.source ?? this.#template;
    const draft = this.#storedDraft.read();
    const useDraft = draft !== null && draft.source !== saved;
    this.#text.value = useDraft ? draft.source : saved;
    this.#restored.value = useDraft ? draft.at : null;
    this.#basedOn = useDraft ? draft.basedOn : (this.#base.value?.version ?? 0);
    this.#loading.value = { kind: "loaded" };
  }

  edit(text: string): void {
    if (text === this.#text.value) return;
    this.#text.value = text;
    this.#storeDraft();
  }

  /** Discards the changes; returns the discarded text. */
  discard(): string {
    const discarded = this.#text.value;
    this.#text.value = this.#base.value?.source ?? this.#template;
    this.#basedOn = this.#base.value?.version ?? 0;
    this.#restored.value = null;
    this.#conflict.value = null;
    this.#storedDraft.remove();
    return discarded;
  }

  /** Saves the text and returns whether it was saved. The text stays after an error. */
  async save(): Promise<boolean> {
    if (this.#saving.value) return false;
    const source = this.#text.value;
    this.#saving.value = true;
    this.#saveError.value = "";
    try {
      const saved = await this.#library.save(this.robotType, this.name, source, this.#basedOn);
      this.#applySaved(saved, source);
      return true;
    } catch (error) {
      if (error instanceof MovementChanged) await this.#loadConflict();
      else this.#saveError.value = sentence(error);
      return false;
    } finally {
      this.#saving.value = false;
    }
  }

  /** Saves this text as the newest version; versions of other users remain in the list. */
  async saveOver(): Promise<boolean> {
    this.#basedOn = this.#conflict.value?.theirs?.version ?? 0;
    this.#conflict.value = null;
    return this.save();
  }

  /** Uses the other user's version; returns the discarded text. */
  takeTheirs(): string {
    const theirs = this.#conflict.value?.theirs ?? null;
    this.#base.value = theirs;
    return this.discard();
  }

  #applySaved(saved: Movement, source: string): void {
    this.#base.value = { ...saved, source };
    this.#basedOn = saved.version;
    this.#conflict.value = null;
    this.#restored.value = null;
    // The user may have edited the text during the save.
    this.#storeDraft();
  }

  #storeDraft(): void {
    if (this.#text.value === (this.#base.value?.source ?? this.#template)) this.#storedDraft.remove();
    else this.#storedDraft.write({ source: this.#text.value, basedOn: this.#basedOn, at: Date.now() });
  }

  async #loadConflict(): Promise<void> {
    try {
      this.#conflict.value = { theirs: await this.#newest() };
    } catch (error) {
      this.#saveError.value = sentence(error);
    }
  }

  async #newest(): Promise<MovementSource | null> {
    try {
      return await this.#library.get(this.robotType, this.name);
    } catch (error) {
      if (error instanceof ApiError && error.code === "movement-unknown") return null;
      throw error;
    }
  }
}
