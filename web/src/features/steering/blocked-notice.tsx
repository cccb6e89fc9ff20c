/** Whether the page can move the robot now, and the state of its setpoint stream. */
import type { Control } from "../control/model";
import type { DeviceStore } from "../devices/model";
import type { SetpointStreamer } from "./model/setpoint-streamer";
import { texts } from "./texts";

/** Why the page cannot move the robot now; `null` if it can. */
export function blockedReason(device: DeviceStore, control: Control): string | null {
  if (device.description.value?.streaming === false) return texts.steer.noStreaming;
  if (control.streamer.value === null) return texts.joints.takeFirst;
  const mode = device.mode.value;
  if (device.stopped.value) return texts.joints.stopped;
  if (!device.live.value) return texts.joints.waiting;
  if (mode === "action") return texts.joints.busy;
  const link = control.linkStatus.value;
  if (link?.state === "up") return null;
  if (link !== null && link.reason !== "") return texts.steer.lostConnection(link.reason);
  return texts.steer.noConnection;
}

interface BlockedNoticeProps {
  device: DeviceStore;
  streamer: SetpointStreamer | null;
  blocked: string | null;
}

export function BlockedNotice({ device, streamer, blocked }: BlockedNoticeProps) {
  const [state, text] = streamText(device, streamer, blocked);
  const limited = state === "streaming" && (device.limited.value !== "" || streamer?.warning.value !== null);
  return (
    <span class={`quiet stream-${limited ? "limited" : state}`} data-testid="stream-state" data-state={state} role="status">
      {text}
    </span>
  );
}

function streamText(device: DeviceStore, streamer: SetpointStreamer | null, blocked: string | null): [string, string] {
  if (blocked !== null || streamer === null) return ["blocked", blocked ?? ""];
  const state = streamer.state.value;
  const warning = streamer.warning.value;
  if (state !== "idle" && warning !== null) return [state, texts.joints.warning(warning)];
  if (state === "waiting") return [state, texts.joints.waiting];
  if (state === "streaming") {
    if (device.limited.value !== "") return [state, texts.joints.limited(device.limited.value)];
    return [state, streamer.steeringMode.value === "joints" ? texts.joints.streaming : texts.steer.holding];
  }
  const ended = streamer.ended.value;
  if (ended === "paused") return ["paused", texts.joints.paused(streamer.pause.value)];
  return [state, ended === null ? "" : texts.joints.ended[ended]];
}
