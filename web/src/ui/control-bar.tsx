import type { Control } from "../core/control";
import type { DeviceStore } from "../core/device";
import type { StopSwitch } from "../core/stop";
import { texts } from "../texts";

interface ControlBarProps {
  device: DeviceStore;
  control: Control;
  stop: StopSwitch;
}

/** Always in sight: who has control, taking and giving it back, and Stop. */
export function ControlBar({ device, control, stop }: ControlBarProps) {
  const state = control.state.value;
  const held = state.kind === "held";
  const describedYet = device.description.value !== null;
  const watches = device.info.value.role === "viewer";
  const resumable = device.holder.value?.mine === true && !held;
  return (
    <div class="control-bar" role="region" aria-label={texts.control.title}>
      <ControlState device={device} control={control} />
      {held ? (
        <button type="button" data-testid="release-control" onClick={() => void control.release()}>
          {texts.control.release}
        </button>
      ) : (
        <button
          type="button"
          class="primary"
          data-testid="take-control"
          disabled={state.kind === "taking" || !describedYet || watches}
          title={watches ? texts.control.watches : describedYet ? undefined : texts.control.needsDescription}
          onClick={() => void control.take()}
        >
          {state.kind === "taking" ? texts.control.taking : resumable ? texts.control.resume : texts.control.take}
        </button>
      )}
      <button
        type="button"
        class="stop"
        data-testid="stop"
        disabled={watches}
        title={watches ? texts.control.watches : texts.stop.keyExplained}
        aria-keyshortcuts="Escape"
        onClick={() => {
          control.stopped();
          stop.press();
        }}
      >
        {texts.stop.press} <kbd>{texts.stop.key}</kbd>
      </button>
    </div>
  );
}

type Shown = "mine" | "other" | "free" | "lost" | "refused" | "taking";

function ControlState({ device, control }: { device: DeviceStore; control: Control }) {
  const [shown, text] = describe(device, control);
  return (
    <p class={`control-state control-${shown}`} data-testid="control-state" data-state={shown} role="status">
      <span class="dot" aria-hidden="true" />
      {text}
    </p>
  );
}

function describe(device: DeviceStore, control: Control): [Shown, string] {
  const state = control.state.value;
  switch (state.kind) {
    case "taking":
      return ["taking", texts.control.taking];
    case "held":
      return ["mine", state.confirmed ? texts.control.mine : texts.control.unconfirmed];
    case "lost":
      return ["lost", texts.control.lost(state.why)];
    case "refused":
      return ["refused", texts.control.refused(state.why)];
    case "none": {
      const holder = device.holder.value;
      if (holder === null) return ["free", texts.control.free];
      return ["other", holder.mine ? texts.control.elsewhere : texts.control.other(holder.name)];
    }
  }
}
