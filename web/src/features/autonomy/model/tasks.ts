/** Conditions and success rates of tasks in words, and the trials of a task page by page. */
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import type { Rate, Task, Trial, TrialFilter } from "../../../shared/api/tasks";
import { shareText } from "./figures";

const PAGE = 20;
export const MAX_SEED = 1_000_000;

type Take = (name: string) => unknown;

/** The condition of a task as sentences. Fields that this console does not know are listed with their values. */
export function conditionOf({ success, observed }: Pick<Task, "success" | "observed">): string {
  const left = new Map(Object.entries(success));
  const take: Take = (name) => {
    const value = left.get(name);
    left.delete(name);
    return value;
  };
  const has = (...names: string[]): boolean => names.every((name) => left.has(name));
  const sentences =
    observed === "measurement" ? measured(take)
    : has("joint", "at_least") ? moved(take)
    : has("object", "region") ? placed(take)
    : has("object", "lifted_m") ? held(take)
    : [];
  const others = [...left].map(([name, value]) => `${name} = ${textOf(value)}`);
  if (others.length > 0) sentences.push(`${sentences.length > 0 ? "In addition: " : ""}${others.join(", ")}.`);
  return sentences.join(" ");
}

function moved(take: Take): string[] {
  const part = nameOf(take("joint"));
  return [`The robot moves ${part} to a position of at least ${textOf(take("at_least"))}. Then ${part} is at rest for ${textOf(take("rest_s"))} s.`];
}

function placed(take: Take): string[] {
  const [object, region, lifted, restS, point] = [nameOf(take("object")), nameOf(take("region")), take("lifted_m"), take("rest_s"), take("point_m")];
  const center = point === undefined || (Array.isArray(point) && point.every((each) => each === 0));
  const what = center ? object : `the point ${textOf(point)} m of ${object}`;
  const first = lifted === undefined ? [] : [liftedText(object, lifted)];
  return [...first, `Then ${what} is at rest in ${region} for ${textOf(restS)} s, and the robot does not touch ${object}.`];
}

function held(take: Take): string[] {
  const [object, lifted, restS] = [nameOf(take("object")), take("lifted_m"), take("rest_s")];
  return [liftedText(object, lifted), `It holds ${object} there for ${textOf(restS)} s.`];
}

function liftedText(object: string, height: unknown): string {
  return `The robot lifts ${object} by at least ${textOf(typeof height === "number" ? Math.round(height * 1000) : height)} mm.`;
}

function measured(take: Take): string[] {
  const [device, stream, field, restS] = [take("device"), take("stream"), take("field"), take("rest_s")];
  const [above, below, equals, staleS] = [take("above"), take("below"), take("equals"), take("stale_s")];
  const is = above !== undefined ? `is above ${textOf(above)}` : below !== undefined ? `is below ${textOf(below)}` : `is ${textOf(equals)}`;
  return [
    `The value ${textOf(field)} of the stream ${textOf(stream)} of the device ${textOf(device)} ${is} for ${textOf(restS)} s.`,
    `It is not met before the trial, and no measurement is older than ${textOf(staleS)} s.`,
  ];
}

function textOf(value: unknown): string {
  return typeof value === "string" ? value : JSON.stringify(value);
}

function nameOf(name: unknown): string {
  return `the ${textOf(name).replaceAll("_", " ")}`;
}

/** 9 of 10 (90 %), 95 % interval 59.6 % to 98.2 %. */
export function rateText({ trials, successes, rate, lower, upper }: Rate): string {
  if (rate === null) return "no trials with a verdict";
  return `${successes} of ${trials} (${shareText(rate)}), 95 % interval ${shareText(lower)} to ${shareText(upper)}`;
}

/** The seed in a field: null for an empty field, which means a random seed; undefined: not a seed. */
export function seedOf(text: string): number | null | undefined {
  if (text.trim() === "") return null;
  const seed = Number(text);
  return Number.isInteger(seed) && seed >= 0 && seed <= MAX_SEED ? seed : undefined;
}

export class TrialHistory {
  readonly #api: Api;
  readonly #task: readonly [robotType: string, name: string];
  readonly #filter: TrialFilter;
  readonly #trials = signal<readonly Trial[] | null>(null);
  readonly #busy = signal(false);
  readonly #error = signal("");
  readonly #cursor = signal<string | null>(null);
  /** Each call replaces the previous one: a late response of an earlier call is ignored. */
  #call = 0;

  /** Newest first; null before the first response. */
  readonly trials: ReadonlySignal<readonly Trial[] | null> = this.#trials;
  readonly busy: ReadonlySignal<boolean> = this.#busy;
  readonly error: ReadonlySignal<string> = this.#error;
  /** The cursor of older trials; null: there are none. */
  readonly more: ReadonlySignal<string | null> = this.#cursor;

  constructor(api: Api, robotType: string, name: string, filter: TrialFilter) {
    this.#api = api;
    this.#task = [robotType, name];
    this.#filter = filter;
  }

  /** Reads the newest page again, and drops older ones unless they join it. */
  async refresh(): Promise<void> {
    if (this.#busy.value) return;
    await this.#read(null, (items, cursor) => {
      const known = this.#trials.value ?? [];
      const last = items.at(-1)?.action;
      const joins = known.findIndex(({ action }) => action === last);
      const older = joins < 0 ? [] : known.slice(joins + 1);
      this.#trials.value = [...items, ...older];
      if (older.length === 0) this.#cursor.value = cursor;
    });
  }

  /** Appends the next page. Trials that were read already stay after an error. */
  async loadOlder(): Promise<void> {
    this.#busy.value = true;
    await this.#read(this.#cursor.value, (items, cursor) => {
      this.#trials.value = [...(this.#trials.value ?? []), ...items];
      this.#cursor.value = cursor;
    });
    this.#busy.value = false;
  }

  async #read(cursor: string | null, apply: (items: Trial[], cursor: string | null) => void): Promise<void> {
    const call = ++this.#call;
    try {
      const page = await this.#api.tasks.trials(...this.#task, this.#filter, cursor, PAGE);
      if (call !== this.#call) return;
      apply(page.items, page.cursor);
      this.#error.value = "";
    } catch (error) {
      if (call === this.#call) this.#error.value = sentence(error);
    }
  }
}
