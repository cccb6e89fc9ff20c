/** Operates one device from this page: control, Stop and actions. */
import { ActionRunner } from "../../actions/model";
import { CommandTrace } from "./command-trace";
import { Control } from "./lease";
import type { SetpointPreference } from "./setpoint-preference";
import { StopSwitch } from "./stop";
import { Watchers } from "./watchers";
import { LatencySamples } from "../../latency/model";
import type { Api } from "../../../shared/api/client";
import type { DeviceStore } from "../../devices/model";
import type { Link } from "../../../shared/mqtt/mqtt-link";

export class DeviceSession {
  readonly device: DeviceStore;
  /** Id of this account. */
  readonly account: string;
  readonly control: Control;
  readonly setpointPreference: SetpointPreference;
  readonly stop: StopSwitch;
  readonly actions: ActionRunner;
  readonly commandTrace: CommandTrace;
  readonly #samples: LatencySamples;
  readonly watchers: Watchers;
  readonly #unwatch: () => void;

  constructor(api: Api, link: Link, device: DeviceStore, account: string, preferred: SetpointPreference) {
    this.device = device;
    this.account = account;
    this.#unwatch = device.watchDetails();
    this.setpointPreference = preferred;
    this.control = new Control(api, device, undefined, () => preferred.transport.value);
    this.stop = new StopSwitch(api, device, link, account);
    this.actions = new ActionRunner(api, device);
    this.commandTrace = new CommandTrace(device, this.control, this.actions);
    this.#samples = new LatencySamples(api, device.id, this.control.roundTrip);
    this.watchers = new Watchers(api, device.id);
  }

  /** Stops the device and ends all streams. */
  stopNow(): void {
    this.control.onStop();
    this.stop.press();
  }

  dispose(): void {
    this.commandTrace.dispose();
    this.#samples.dispose();
    this.control.dispose();
    this.watchers.setVisible(false);
    this.stop.dispose();
    this.actions.dispose();
    this.#unwatch();
  }
}
