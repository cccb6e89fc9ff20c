/** All with which one device is operated from this page: control of it, its stop, what it is asked to do. */
import type { Api } from "../../../shared/api/client";
import { ActionRunner } from "../../actions/model/action-runner";
import { Control } from "../../control/model/lease";
import type { DeviceStore } from "./device-store";
import { CommandTrace } from "../../control/model/command-trace";
import type { Link } from "../../../shared/mqtt/mqtt-link";
import { LatencySamples } from "../../latency/model/sample-upload";
import { StopSwitch } from "../../control/model/stop";
import { Watchers } from "../../control/model/watchers";

export class DeviceSession {
  readonly device: DeviceStore;
  readonly control: Control;
  readonly stop: StopSwitch;
  readonly actions: ActionRunner;
  readonly commandTrace: CommandTrace;
  readonly #samples: LatencySamples;
  readonly watchers: Watchers;
  readonly #unwatch: () => void;

  /** `by`: who is told to have pressed Stop. */
  constructor(api: Api, link: Link, device: DeviceStore, by: string) {
    this.device = device;
    this.#unwatch = device.watchClosely();
    this.control = new Control(api, device);
    this.stop = new StopSwitch(api, device, link, by);
    this.actions = new ActionRunner(api, device);
    this.commandTrace = new CommandTrace(device, this.control, this.actions);
    this.#samples = new LatencySamples(api, device.id, this.control.roundTrip);
    this.watchers = new Watchers(api, device.id);
  }

  /** Stop the device, and send nothing more. */
  stopNow(): void {
    this.control.stopped();
    this.stop.press();
  }

  dispose(): void {
    this.commandTrace.dispose();
    this.#samples.dispose();
    this.control.dispose();
    this.watchers.seen(false);
    this.stop.dispose();
    this.actions.dispose();
    this.#unwatch();
  }
}
