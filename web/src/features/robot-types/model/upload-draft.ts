/** A robot type upload: its files until saved, and the server's validation results. */
import { batch, computed, signal, type ReadonlySignal } from "@preact/signals-core";
import { now } from "../../../shared/lib/clock";
import { readFindings, type Finding } from "./parse-findings";
import { ApiError, sentence } from "../../../shared/api/http";
import type { TypePreview, RobotType, RobotTypes, TypeModel } from "../../../shared/api/robot-types";
import { selectFiles, MANIFEST, MAX_BYTES, packFiles, size, type Files } from "./upload-files";

type DraftStep = "empty" | "sending" | "checking" | "valid" | "invalid" | "unsent" | "saving" | "saved";

/** The result of saving one of the type's movements. */
interface SavedMovement {
  name: string;
  /** The error, or "". */
  error: string;
}

/** Errors that prevent sending. */
type LocalError = "no-manifest" | "too-large" | null;

const POLL_MS = 500;

/** Files can be replaced at any time; pending results for the previous files are discarded. */
export class UploadDraft {
  readonly #types: RobotTypes;
  readonly #files = signal<Files>(new Map());
  readonly #ignored = signal<readonly string[]>([]);
  readonly #step = signal<DraftStep>("empty");
  readonly #preview = signal<TypePreview | null>(null);
  readonly #model = signal<TypeModel | null>(null);
  readonly #errors = signal<readonly string[]>([]);
  readonly #error = signal("");
  readonly #saved = signal<RobotType | null>(null);
  readonly #movements = signal<readonly SavedMovement[]>([]);
  readonly #since = signal(0);
  #generation = 0;
  #disposed = false;

  readonly files: ReadonlySignal<Files> = this.#files;
  /** Chosen files that a robot type does not use. */
  readonly ignored: ReadonlySignal<readonly string[]> = this.#ignored;
  readonly step: ReadonlySignal<DraftStep> = this.#step;
  readonly preview: ReadonlySignal<TypePreview | null> = this.#preview;
  readonly model: ReadonlySignal<TypeModel | null> = this.#model;
  /** The error of the last attempt, such as an unreachable server. */
  readonly error: ReadonlySignal<string> = this.#error;
  readonly saved: ReadonlySignal<RobotType | null> = this.#saved;
  readonly movements: ReadonlySignal<readonly SavedMovement[]> = this.#movements;
  /** Start of the current step on the page's clock [ms]. */
  readonly since: ReadonlySignal<number> = this.#since;
  readonly errors: ReadonlySignal<readonly Finding[]> = computed(() => readFindings(this.#errors.value));
  readonly warnings: ReadonlySignal<readonly Finding[]> = computed(() =>
    readFindings(this.#preview.value?.robot_type.upload?.warnings ?? []),
  );
  readonly localError: ReadonlySignal<LocalError> = computed(() => {
    const files = this.#files.value;
    if (files.size === 0) return null;
    if (!files.has(MANIFEST)) return "no-manifest";
    return size(files) > MAX_BYTES ? "too-large" : null;
  });
  readonly busy: ReadonlySignal<boolean> = computed(() => ["sending", "checking", "saving"].includes(this.#step.value));

  constructor(types: RobotTypes) {
    this.#types = types;
  }

  /** Adds files, replaces those with the same name, and validates all. */
  async add(entries: Files): Promise<void> {
    const { files, ignored } = selectFiles(entries);
    // A single file replaces the file with the same name in any folder.
    for (const [name, content] of [...files]) {
      const matches = [...this.#files.value.keys()].filter((each) => each.endsWith(`/${name}`));
      if (name.includes("/") || this.#files.value.has(name) || matches.length !== 1) continue;
      files.delete(name);
      files.set(matches[0] ?? name, content);
    }
    await this.#change(new Map([...this.#files.value, ...files]), ignored);
  }

  /** Replaces file `name`. The replacement may have any local name. */
  async replace(name: string, content: Uint8Array): Promise<void> {
    await this.#change(new Map([...this.#files.value, [name, content]]), []);
  }

  async remove(name: string): Promise<void> {
    await this.#change(new Map([...this.#files.value].filter(([each]) => each !== name)), []);
  }

  async clear(): Promise<void> {
    await this.#change(new Map(), []);
  }

  /** Sends all files and waits for the result. */
  async check(): Promise<void> {
    const generation = this.#start("sending");
    const folder = packFiles(this.#files.value);
    if (folder === null || this.localError.value !== null) {
      this.#step.value = this.#files.value.size === 0 ? "empty" : "invalid";
      return;
    }
    try {
      let preview = await this.#types.createPreview(folder);
      if (this.#outdated(generation)) {
        void this.#deletePreview(preview);
        return;
      }
      batch(() => {
        this.#preview.value = preview;
        this.#setStep("checking");
      });
      while (preview.robot_type.upload?.state === "checking") {
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
        if (this.#outdated(generation)) return;
        preview = await this.#types.preview(preview.id);
        if (this.#outdated(generation)) return;
      }
      const errors = preview.robot_type.upload?.errors ?? [];
      const model = errors.length === 0 ? await this.#modelOf(preview) : null;
      if (this.#outdated(generation)) return;
      batch(() => {
        this.#preview.value = preview;
        this.#errors.value = errors;
        this.#model.value = model;
        this.#setStep(errors.length === 0 ? "valid" : "invalid");
      });
    } catch (error) {
      if (!this.#outdated(generation)) this.#fail(error);
    }
  }

  /** Saves the robot type and its movements. */
  async save(): Promise<void> {
    const preview = this.#preview.value;
    if (preview === null || this.#step.value !== "valid") return;
    const generation = this.#generation;
    this.#error.value = "";
    this.#setStep("saving");
    try {
      let saved = await this.#types.savePreview(preview.id);
      while (saved.upload?.state === "checking") {
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
        if (this.#outdated(generation)) return;
        saved = await this.#types.get(saved.type);
      }
      const movements = await this.#saveMovements(saved.type);
      if (this.#outdated(generation)) return;
      batch(() => {
        this.#preview.value = null;
        this.#saved.value = saved;
        this.#movements.value = movements;
        this.#setStep("saved");
      });
    } catch (error) {
      if (this.#outdated(generation)) return;
      batch(() => {
        this.#error.value = sentence(error);
        this.#setStep("valid");
      });
    }
  }

  dispose(): void {
    this.#disposed = true;
    this.#discardPreview();
  }

  async #modelOf(preview: TypePreview): Promise<TypeModel | null> {
    try {
      return await this.#types.previewModel(preview.id);
    } catch (error) {
      // A model that cannot be drawn can still be valid; a warning reports it.
      if (error instanceof ApiError && error.code === "model-unknown") return null;
      throw error;
    }
  }

  async #saveMovements(type: string): Promise<SavedMovement[]> {
    const saved: SavedMovement[] = [];
    for (const [name, source] of Object.entries(packFiles(this.#files.value)?.movements ?? {})) {
      try {
        await this.#types.putMovement(type, name, source);
        saved.push({ name, error: "" });
      } catch (error) {
        saved.push({ name, error: sentence(error) });
      }
    }
    return saved;
  }

  async #change(files: Files, ignored: readonly string[]): Promise<void> {
    batch(() => {
      this.#files.value = files;
      this.#ignored.value = ignored;
    });
    await this.check();
  }

  #start(step: DraftStep): number {
    this.#discardPreview();
    batch(() => {
      this.#model.value = null;
      this.#errors.value = [];
      this.#error.value = "";
      this.#saved.value = null;
      this.#movements.value = [];
      this.#setStep(step);
    });
    this.#generation += 1;
    return this.#generation;
  }

  #setStep(step: DraftStep): void {
    this.#step.value = step;
    this.#since.value = now();
  }

  /** The server rejected the files or was unreachable. */
  #fail(error: unknown): void {
    const details = error instanceof ApiError ? error.extra["errors"] : undefined;
    const errors = Array.isArray(details) ? details.filter((each): each is string => typeof each === "string") : [];
    const rejected = error instanceof ApiError && (error.status === 422 || error.code === "robot-type-built-in");
    batch(() => {
      this.#errors.value = errors.length > 0 || !rejected ? errors : [`robot.toml: ${sentence(error)}`];
      this.#error.value = rejected ? "" : sentence(error);
      this.#setStep(rejected ? "invalid" : "unsent");
    });
  }

  #outdated(generation: number): boolean {
    return this.#disposed || generation !== this.#generation;
  }

  #discardPreview(): void {
    const preview = this.#preview.value;
    this.#preview.value = null;
    if (preview !== null) void this.#deletePreview(preview);
  }

  async #deletePreview(preview: TypePreview): Promise<void> {
    try {
      await this.#types.deletePreview(preview.id);
    } catch {
      // The server deletes it later.
    }
  }
}
