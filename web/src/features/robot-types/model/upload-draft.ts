/** A robot type upload: its files until saved, and the server's validation results. */
import { batch, computed, signal, type ReadonlySignal } from "@preact/signals-core";
import { now } from "../../../shared/lib/clock";
import { readFindings, type Finding } from "./parse-findings";
import { ApiError, sentence } from "../../../shared/api/http";
import type { TypePreview, RobotType, RobotTypes, TypeModel } from "../../../shared/api/robot-types";
import { selectFiles, MANIFEST, MAX_BYTES, packFiles, size, type Files } from "./upload-files";

type DraftStep = "empty" | "sending" | "checking" | "good" | "wrong" | "unsent" | "saving" | "saved";

/** The result of saving one of the type's movements. */
interface SavedMovement {
  name: string;
  /** The error, or "". */
  why: string;
}

/** Errors that prevent sending. */
type LocalFault = "no-manifest" | "too-large" | null;

const ASK_EVERY_MS = 500;

/** Files can be replaced at any time; pending results for the previous files are discarded. */
export class UploadDraft {
  readonly #types: RobotTypes;
  readonly #files = signal<Files>(new Map());
  readonly #left = signal<readonly string[]>([]);
  readonly #step = signal<DraftStep>("empty");
  readonly #look = signal<TypePreview | null>(null);
  readonly #model = signal<TypeModel | null>(null);
  readonly #errors = signal<readonly string[]>([]);
  readonly #trouble = signal("");
  readonly #saved = signal<RobotType | null>(null);
  readonly #movements = signal<readonly SavedMovement[]>([]);
  readonly #since = signal(0);
  #round = 0;
  #disposed = false;

  readonly files: ReadonlySignal<Files> = this.#files;
  /** Chosen files that a robot type does not use. */
  readonly left: ReadonlySignal<readonly string[]> = this.#left;
  readonly step: ReadonlySignal<DraftStep> = this.#step;
  readonly look: ReadonlySignal<TypePreview | null> = this.#look;
  readonly model: ReadonlySignal<TypeModel | null> = this.#model;
  /** The error of the last attempt, such as an unreachable server. */
  readonly trouble: ReadonlySignal<string> = this.#trouble;
  readonly saved: ReadonlySignal<RobotType | null> = this.#saved;
  readonly movements: ReadonlySignal<readonly SavedMovement[]> = this.#movements;
  /** Start of the current step on the page's clock [ms]. */
  readonly since: ReadonlySignal<number> = this.#since;
  readonly errors: ReadonlySignal<readonly Finding[]> = computed(() => readFindings(this.#errors.value));
  readonly warnings: ReadonlySignal<readonly Finding[]> = computed(() =>
    readFindings(this.#look.value?.robot_type.upload?.warnings ?? []),
  );
  readonly fault: ReadonlySignal<LocalFault> = computed(() => {
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
    const { files, left } = selectFiles(entries);
    // A single file replaces the file with the same name in any folder.
    for (const [name, content] of [...files]) {
      const known = [...this.#files.value.keys()].filter((each) => each.endsWith(`/${name}`));
      if (name.includes("/") || this.#files.value.has(name) || known.length !== 1) continue;
      files.delete(name);
      files.set(known[0] ?? name, content);
    }
    await this.#change(new Map([...this.#files.value, ...files]), left);
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
    const round = this.#begin("sending");
    const folder = packFiles(this.#files.value);
    if (folder === null || this.fault.value !== null) {
      this.#step.value = this.#files.value.size === 0 ? "empty" : "wrong";
      return;
    }
    try {
      let look = await this.#types.createPreview(folder);
      if (this.#past(round)) {
        void this.#forget(look);
        return;
      }
      batch(() => {
        this.#look.value = look;
        this.#to("checking");
      });
      while (look.robot_type.upload?.state === "checking") {
        await new Promise((resolve) => setTimeout(resolve, ASK_EVERY_MS));
        if (this.#past(round)) return;
        look = await this.#types.preview(look.id);
        if (this.#past(round)) return;
      }
      const errors = look.robot_type.upload?.errors ?? [];
      const model = errors.length === 0 ? await this.#modelOf(look) : null;
      if (this.#past(round)) return;
      batch(() => {
        this.#look.value = look;
        this.#errors.value = errors;
        this.#model.value = model;
        this.#to(errors.length === 0 ? "good" : "wrong");
      });
    } catch (error) {
      if (!this.#past(round)) this.#refuse(error);
    }
  }

  /** Saves the robot type and its movements. */
  async save(): Promise<void> {
    const look = this.#look.value;
    if (look === null || this.#step.value !== "good") return;
    const round = this.#round;
    this.#trouble.value = "";
    this.#to("saving");
    try {
      let saved = await this.#types.savePreview(look.id);
      while (saved.upload?.state === "checking") {
        await new Promise((resolve) => setTimeout(resolve, ASK_EVERY_MS));
        if (this.#past(round)) return;
        saved = await this.#types.get(saved.type);
      }
      const movements = await this.#saveMovements(saved.type);
      if (this.#past(round)) return;
      batch(() => {
        this.#look.value = null;
        this.#saved.value = saved;
        this.#movements.value = movements;
        this.#to("saved");
      });
    } catch (error) {
      if (this.#past(round)) return;
      batch(() => {
        this.#trouble.value = sentence(error);
        this.#to("good");
      });
    }
  }

  dispose(): void {
    this.#disposed = true;
    this.#dropLook();
  }

  async #modelOf(look: TypePreview): Promise<TypeModel | null> {
    try {
      return await this.#types.previewModel(look.id);
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
        saved.push({ name, why: "" });
      } catch (error) {
        saved.push({ name, why: sentence(error) });
      }
    }
    return saved;
  }

  async #change(files: Files, left: readonly string[]): Promise<void> {
    batch(() => {
      this.#files.value = files;
      this.#left.value = left;
    });
    await this.check();
  }

  #begin(step: DraftStep): number {
    this.#dropLook();
    batch(() => {
      this.#model.value = null;
      this.#errors.value = [];
      this.#trouble.value = "";
      this.#saved.value = null;
      this.#movements.value = [];
      this.#to(step);
    });
    this.#round += 1;
    return this.#round;
  }

  #to(step: DraftStep): void {
    this.#step.value = step;
    this.#since.value = now();
  }

  /** The server rejected the files or was unreachable. */
  #refuse(error: unknown): void {
    const told = error instanceof ApiError ? error.extra["errors"] : undefined;
    const errors = Array.isArray(told) ? told.filter((each): each is string => typeof each === "string") : [];
    const refused = error instanceof ApiError && (error.status === 422 || error.code === "robot-type-built-in");
    batch(() => {
      this.#errors.value = errors.length > 0 || !refused ? errors : [`robot.toml: ${sentence(error)}`];
      this.#trouble.value = refused ? "" : sentence(error);
      this.#to(refused ? "wrong" : "unsent");
    });
  }

  #past(round: number): boolean {
    return this.#disposed || round !== this.#round;
  }

  #dropLook(): void {
    const look = this.#look.value;
    this.#look.value = null;
    if (look !== null) void this.#forget(look);
  }

  async #forget(look: TypePreview): Promise<void> {
    try {
      await this.#types.deletePreview(look.id);
    } catch {
      // The server deletes it later.
    }
  }
}
