/** Editor state of one movement: changes, selection, preview, and the draft that persists after the page closes. */
import { plan, poseAt } from "./plan";
import { problems } from "./problems";
import { computed, effect, signal, type ReadonlySignal } from "@preact/signals-core";
import { addAfter, duplicate, poseOf, remove, type Movement, type Positions, type Robot } from "./keyframes";
import { readMovement } from "./script-codec";
import { UndoHistory } from "../../../shared/lib/undo-history";

type Storage = Pick<globalThis.Storage, "getItem" | "setItem" | "removeItem">;

export class Editor {
  readonly robot: Robot;
  readonly #history: UndoHistory<Movement>;
  readonly #selected = signal(0);
  readonly #at = signal(0);
  readonly #playing = signal(false);
  readonly #saved;
  readonly #disposeEffect: () => void;

  readonly movement: ReadonlySignal<Movement>;
  readonly canUndo: ReadonlySignal<boolean>;
  readonly canRedo: ReadonlySignal<boolean>;
  readonly plan;
  readonly problems;
  readonly selected;
  /** Preview position on the robot's time scale [s]. */
  readonly at: ReadonlySignal<number> = this.#at;
  readonly playing: ReadonlySignal<boolean> = this.#playing;
  /** Whether the movement differs from the saved version. */
  readonly changed;
  /** Joint positions at the preview position [rad]. */
  readonly pose;

  /** `saved`: the cloud's version, `null`: none. `draft`: stored in this browser. `initial`: used if both are absent. */
  constructor(
    robot: Robot,
    from: { saved: Movement | null; draft: Movement | null; initial: Movement },
    storeDraft: (movement: Movement | null) => void,
  ) {
    const { saved, draft, initial } = from;
    this.robot = robot;
    const history = new UndoHistory(draft ?? saved ?? initial);
    this.#history = history;
    this.#saved = signal(saved);
    this.movement = history.now;
    this.canUndo = history.canUndo;
    this.canRedo = history.canRedo;
    this.plan = computed(() => plan(history.now.value, robot));
    this.problems = computed(() => problems(history.now.value, robot));
    this.selected = computed(() => Math.min(this.#selected.value, history.now.value.keyframes.length - 1));
    this.changed = computed(() => JSON.stringify(history.now.value) !== JSON.stringify(this.#saved.value));
    this.pose = computed(() => this.plan.value.at(this.#at.value));
    // An unedited movement is not stored as a draft.
    this.#disposeEffect = effect(() => storeDraft(this.changed.value && (draft !== null || this.canUndo.value) ? this.movement.value : null));
  }

  change(next: Movement, gesture = ""): void {
    this.#playing.value = false;
    this.#history.change(next, gesture);
    this.#seekToSelected();
  }

  /** Ends a drag. */
  endGesture(): void {
    this.#history.endGesture();
  }

  undo(): void {
    this.#history.undo();
    this.#seekToSelected();
  }

  redo(): void {
    this.#history.redo();
    this.#seekToSelected();
  }

  select(index: number): void {
    this.#playing.value = false;
    this.#selected.value = Math.max(0, Math.min(index, this.movement.value.keyframes.length - 1));
    this.#seekToSelected();
  }

  /** Adds a keyframe with these positions after the selected one. */
  add(positions: Positions): void {
    this.change(addAfter(this.movement.value, this.selected.value, poseOf(positions, this.robot)));
    this.select(this.selected.value + 1);
  }

  duplicateSelected(): void {
    this.change(duplicate(this.movement.value, this.selected.value));
    this.select(this.selected.value + 1);
  }

  deleteSelected(): void {
    this.change(remove(this.movement.value, this.selected.value));
    this.select(this.selected.value);
  }

  /** Every joint's position at a keyframe, including interpolated ones [rad]. */
  poseAtKeyframe(index: number): Positions {
    return this.plan.value.at(this.plan.value.reached_s[index] ?? 0);
  }

  /** Moves the preview to a time on the scale of the keyframes [s]. */
  scrub(time_s: number): void {
    this.#playing.value = false;
    this.#at.value = this.plan.value.previewTime(time_s);
  }

  play(): void {
    if (this.#at.value >= this.plan.value.duration_s - 1e-6) this.#at.value = 0;
    this.#playing.value = true;
  }

  pause(): void {
    this.#playing.value = false;
  }

  /** Advances the preview by the elapsed time [s]. */
  tick(elapsed_s: number): void {
    if (!this.#playing.value) return;
    this.#at.value = Math.min(this.#at.value + elapsed_s, this.plan.value.duration_s);
    if (this.#at.value >= this.plan.value.duration_s) this.#playing.value = false;
  }

  saved(movement: Movement): void {
    this.#saved.value = movement;
  }

  /** Reverts to the saved version; can be undone. */
  revert(): void {
    if (this.#saved.value !== null) this.change(this.#saved.value);
    this.select(0);
  }

  dispose(): void {
    this.#disposeEffect();
  }

  #seekToSelected(): void {
    this.#at.value = this.plan.value.reached_s[this.selected.value] ?? 0;
  }
}

/** A movement of one keyframe: the measured pose, or, if unknown, every joint at 0 or at the limit nearest to 0. */
export function newMovement(robot: Robot, measured: Positions | null): Movement {
  const positions = measured ?? poseAt(Object.fromEntries(robot.joints.map(({ name }) => [name, 0])), robot);
  return { description: "", keyframes: [{ time_s: 0, position_rad: poseOf(positions, robot) }] };
}

/** Drafts by robot type and name; an unnamed movement has one draft per robot type. */
export class Drafts {
  readonly #storage: Storage;

  constructor(storage: Storage) {
    this.#storage = storage;
  }

  read(robotType: string, name: string): Movement | null {
    try {
      return readMovement(JSON.parse(this.#storage.getItem(key(robotType, name)) ?? "null"));
    } catch {
      return null; // Unreadable content counts as no draft.
    }
  }

  /** Whether the draft was stored: storage can be full or forbidden. */
  storeDraft(robotType: string, name: string, movement: Movement | null): boolean {
    try {
      if (movement === null) this.#storage.removeItem(key(robotType, name));
      else this.#storage.setItem(key(robotType, name), JSON.stringify(movement));
      return true;
    } catch {
      return false;
    }
  }
}

function key(robotType: string, name: string): string {
  return `telescope.keyframes.${robotType}.${name}`;
}
