/** All with which one device is operated from this page: control of it, its stop, what it is asked to do. */
import type { Api } from "../../../shared/api/client";
import { ActionRunner } from "../../actions/model/action-runner";
import { Control } from "../../control/model/lease";
import type { DeviceStore } from "./device-store";
import { Evidence } from "../../control/model/command-trace";
import type { Link } from "../../../shared/mqtt/mqtt-link";
import { LatencySamples } from "../../latency/model/sample-upload";
import { StopSwitch } from "../../control/model/stop";
import { Watching } from "../../control/model/watchers";

export class Station {
  readonly device: DeviceStore;
  readonly control: Control;
  readonly stop: StopSwitch;
  readonly actions: ActionRunner;
  readonly evidence: Evidence;
  readonly #samples: LatencySamples;
  readonly watching: Watching;
  readonly #unwatch: () => void;

  /** `by`: who is told to have pressed Stop. */
  constructor(api: Api, link: Link, device: DeviceStore, by: string) {
    this.device = device;
    this.#unwatch = device.watchClosely();
    this.control = new Control(api, device);
    this.stop = new StopSwitch(api, device, link, by);
    this.actions = new ActionRunner(api, device);
    this.evidence = new Evidence(device, this.control, this.actions);
    this.#samples = new LatencySamples(api, device.id, this.control.roundTrip);
    this.watching = new Watching(api, device.id);
  }

  /** Stop the device, and send nothing more. */
  stopNow(): void {
    this.control.stopped();
    this.stop.press();
  }

  dispose(): void {
    this.evidence.dispose();
    this.#samples.dispose();
    this.control.dispose();
    this.watching.seen(false);
    this.stop.dispose();
    this.actions.dispose();
    this.#unwatch();
  }
}
