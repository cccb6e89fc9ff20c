/** What carries setpoints from this browser, where a site offers a choice. */
import { signal, type ReadonlySignal } from "@preact/signals-core";
import type { StoredValue } from "../../../shared/lib/local-storage";
import type { SetpointTransport } from "../../../shared/mqtt/mqtt-link";

export class SetpointPreference {
  readonly #stored: StoredValue<SetpointTransport>;
  readonly #transport;

  /** Applies when control is taken. */
  readonly transport: ReadonlySignal<SetpointTransport>;

  constructor(stored: StoredValue<SetpointTransport>) {
    this.#stored = stored;
    this.transport = this.#transport = signal(stored.read() ?? "mqtt");
  }

  choose(transport: SetpointTransport): void {
    this.#transport.value = transport;
    this.#stored.write(transport);
  }
}
