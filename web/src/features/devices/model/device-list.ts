/** All devices that this account can access. */
import type { Device } from "../../../shared/api/types";
import { effect, signal, type ReadonlySignal } from "@preact/signals-core";
import type { Api } from "../../../shared/api/client";
import { sentence } from "../../../shared/api/http";
import { DeviceStore } from "./device-store";
import { MqttLink, type Link } from "../../../shared/mqtt/mqtt-link";

const REFRESH_MS = 15_000;

export class Fleet {
  readonly #api: Api;
  readonly link: Link;
  readonly #devices = signal<ReadonlyMap<string, DeviceStore> | null>(null);
  readonly #error = signal<string | null>(null);
  readonly #spaces = signal<ReadonlyMap<string, string>>(new Map());
  readonly #unsubscribes = new Map<string, () => void>();
  readonly #timer: ReturnType<typeof setInterval>;
  readonly #disposeEffect: () => void;
  #disconnected = false;

  /** By id, in list order; `null` until the first response. */
  readonly devices: ReadonlySignal<ReadonlyMap<string, DeviceStore> | null> = this.#devices;
  /** The error of the last read, or `null`. */
  readonly error: ReadonlySignal<string | null> = this.#error;

  constructor(api: Api, link?: Link) {
    this.#api = api;
    this.link = link ?? new MqttLink(() => api.credentials({ purpose: "view" }));
    void this.refresh();
    this.#timer = setInterval(() => void this.refresh(), REFRESH_MS);
    this.#disposeEffect = this.#refreshOnConnectionChange();
  }

  /** The name of a space, or its id until the name is loaded. */
  spaceName(id: string): string {
    return this.#spaces.value.get(id) ?? id;
  }

  async refresh(): Promise<void> {
    try {
      this.#apply(await this.#api.devices());
      if (this.#hasUnnamedSpace()) this.#spaces.value = new Map((await this.#api.spaces()).map(({ id, name }) => [id, name]));
      this.#error.value = null;
    } catch (error) {
      this.#error.value = sentence(error);
    }
  }

  /** Pairs an agent by its claim code; returns its devices. Throws `ApiError`. */
  async claim(code: string, space: string | null = null): Promise<Device[]> {
    const devices = await this.#api.claim(code, space);
    await this.refresh();
    return devices;
  }

  dispose(): void {
    clearInterval(this.#timer);
    this.#disposeEffect();
    for (const end of this.#unsubscribes.values()) end();
    this.#unsubscribes.clear();
    this.link.close();
  }

  /** A share that ends or changes closes the connection: reload the list now and after the reconnect. */
  #refreshOnConnectionChange(): () => void {
    let previous = this.link.status.value.state;
    return effect(() => {
      const { state } = this.link.status.value;
      const lost = previous === "up" && state !== "up" && state !== "closed";
      const restored = previous !== "up" && state === "up" && this.#disconnected;
      previous = state;
      if (lost) this.#disconnected = true;
      if (restored) this.#disconnected = false;
      if (lost || restored) queueMicrotask(() => void this.refresh());
    });
  }

  #hasUnnamedSpace(): boolean {
    return [...(this.#devices.value?.values() ?? [])].some(({ info }) => !this.#spaces.value.has(info.value.space));
  }

  #apply(list: readonly Device[]): void {
    const stores = this.#devices.value ?? new Map<string, DeviceStore>();
    const next = new Map<string, DeviceStore>();
    for (const info of list) {
      const store = stores.get(info.id);
      if (store === undefined) {
        const added = new DeviceStore(info, this.#api, this.link);
        this.#unsubscribes.set(info.id, added.watch());
        next.set(info.id, added);
      } else {
        store.update(info);
        next.set(info.id, store);
      }
    }
    const removed = [...stores.keys()].filter((id) => !next.has(id));
    for (const id of removed) {
      this.#unsubscribes.get(id)?.();
      this.#unsubscribes.delete(id);
    }
    const added = [...next.keys()].some((id) => !stores.has(id));
    // Replace the list only if it changed, to avoid needless rendering.
    if (added || removed.length > 0 || this.#devices.value === null) {
      const first = this.#devices.value === null;
      this.#devices.value = next;
      // The credentials fix the topics that this connection may subscribe to.
      if (added && !first) this.link.renew();
    }
  }
}
