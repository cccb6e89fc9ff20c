/** Actions of this page on one room device, one at a time, and their outcome. */
import type { Upload } from "../../../shared/api/types";
import type { ActionOptions, ActionRunner, Run } from "../../actions/model";
import type { DeviceStore } from "../../devices/model";
import type { Values } from "../../spaces/model";
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import { now } from "../../../shared/lib/clock";
import { readApplied, readShot } from "../../../shared/mqtt/parse-messages";
import type { RoomRequest } from "../../../shared/api/action-requests";

/** Timeout of a short action [ms]. */
const TIMEOUT_MS = 30_000;
/** Timeout of a capture: surveying a room takes ten seconds [ms]. */
const CAPTURE_TIMEOUT_MS = 120_000;
const MARGIN_MS = 15_000;

interface SingleMeasurement {
  /** Arrival time on the page's clock [ms]. */
  at: number;
  streams: Readonly<Record<string, Values>>;
}

export interface CapturedFile {
  upload: Upload;
  url: string;
}

/** The requested and the applied value of a control. */
interface Setting {
  requested: number;
  /** `null` until the response, or without one. */
  applied: number | null;
  error: string;
}

export class RoomDeviceAction {
  readonly #api: Api;
  readonly #device: DeviceStore;
  readonly #actions: ActionRunner;
  readonly #epoch: () => number | null;
  readonly #busy = signal<RoomRequest["kind"] | null>(null);
  readonly #error = signal("");
  readonly #measurement = signal<SingleMeasurement | null>(null);
  readonly #settings = signal<ReadonlyMap<string, Setting>>(new Map());
  readonly #uploads = signal<readonly Upload[] | null>(null);
  readonly #pending = new Map<string, number>();
  #setting = false;

  /** The running request. */
  readonly busy: ReadonlySignal<RoomRequest["kind"] | null> = this.#busy;
  /** The error of the last request, or "". */
  readonly error: ReadonlySignal<string> = this.#error;
  /** The last single measurement. */
  readonly measurement: ReadonlySignal<SingleMeasurement | null> = this.#measurement;
  readonly settings: ReadonlySignal<ReadonlyMap<string, Setting>> = this.#settings;
  /** Captured files, newest first; `null` until loaded. */
  readonly uploads: ReadonlySignal<readonly Upload[] | null> = this.#uploads;

  /** `epoch`: the epoch of this page's lease, if any. */
  constructor(api: Api, device: DeviceStore, actions: ActionRunner, epoch: () => number | null) {
    this.#api = api;
    this.#device = device;
    this.#actions = actions;
    this.#epoch = epoch;
  }

  /** Starts measuring streams at this rate; all subscribers receive the data. Returns when it has started. */
  async collect(streams: string[], rateHz: number, durationS: number): Promise<void> {
    const request = { kind: "gather", streams, rate_hz: rateHz, duration_s: durationS } as const;
    await this.#runAction(request, "started", durationS * 1000 + MARGIN_MS);
  }

  /** Cancels the device's current action, including one that another caller started. */
  async cancelCollection(): Promise<void> {
    const running = this.#device.state.value?.action ?? null;
    if (running === null) return;
    this.#error.value = await this.#actions.cancel(running.id);
  }

  async measureOnce(): Promise<void> {
    const run = await this.#runAction({ kind: "shoot", streams: [] }, "done", TIMEOUT_MS);
    if (run === null) return;
    this.#reportErrors(() => (this.#measurement.value = { at: now(), streams: readShot(run.result) }));
  }

  /** Captures raw data; returns its location, or `null` on an error. */
  async capture(name: string): Promise<CapturedFile | null> {
    const run = await this.#runAction({ kind: "capture", name }, "done", CAPTURE_TIMEOUT_MS);
    const id = run?.result["upload"];
    if (typeof id !== "string") return null;
    void this.list();
    return this.file(id);
  }

  /** A captured file with its address. */
  async file(id: string): Promise<CapturedFile | null> {
    try {
      const { url, ...upload } = await this.#api.upload(this.#device.id, id);
      return { upload, url };
    } catch (error) {
      this.#error.value = sentence(error);
      return null;
    }
  }

  async list(): Promise<void> {
    try {
      this.#uploads.value = await this.#api.uploads(this.#device.id, 50);
    } catch (error) {
      this.#error.value = sentence(error);
    }
  }

  /** Sets a control. During a request, only the newest of the following values is sent. */
  async set(control: string, value: number): Promise<void> {
    this.#pending.set(control, value);
    this.#storeSetting(control, { requested: value, applied: null, error: "" });
    if (this.#setting) return;
    this.#setting = true;
    try {
      for (let next = this.#next(); next !== null; next = this.#next()) await this.#setOne(...next);
    } finally {
      this.#setting = false;
    }
  }

  #next(): [string, number] | null {
    const [first] = this.#pending;
    if (first === undefined) return null;
    this.#pending.delete(first[0]);
    return first;
  }

  async #setOne(control: string, value: number): Promise<void> {
    const run = await this.#runAction({ kind: "set_control", control, value }, "done", TIMEOUT_MS);
    const error = this.#error.value;
    this.#error.value = "";
    let setting: Setting = { requested: value, applied: null, error };
    if (run !== null) {
      this.#reportErrors(() => (setting = { requested: value, applied: readApplied(run.result)[control] ?? null, error: "" }));
    }
    // A newer request is pending: its response applies.
    if (!this.#pending.has(control)) this.#storeSetting(control, setting);
  }

  #storeSetting(control: string, setting: Setting): void {
    this.#settings.value = new Map(this.#settings.value).set(control, setting);
  }

  /** The run at the requested status; `null` on an error. */
  async #runAction(request: RoomRequest, waitFor: Required<ActionOptions>["waitFor"], timeoutMs: number): Promise<Run | null> {
    this.#busy.value = request.kind;
    this.#error.value = "";
    const run = await this.#actions.startAndWait(request, { epoch: this.#epoch(), waitFor, timeoutMs });
    this.#busy.value = null;
    if (run.status === "done" || (waitFor === "started" && run.status === "started")) return run;
    this.#error.value = run.reason === "" ? run.status : run.reason;
    return null;
  }

  #reportErrors(read: () => void): void {
    try {
      read();
    } catch (error) {
      this.#error.value = sentence(error);
    }
  }
}
