import type { DeviceStore } from "../devices/model";
import { effect, type ReadonlySignal, useComputed, useSignalEffect } from "@preact/signals";
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { clamp, radians } from "../../shared/lib/angles";
import { PressedInputs } from "./model/pressed-inputs";
import { JOINT_KEYS, jointOfKey } from "./model/keymap";
import type { KnownTelemetry } from "../../shared/mqtt/parse-messages";
import type { Joint } from "../../shared/mqtt/protocol.generated";
import type { SetpointStreamer } from "./model/setpoint-streamer";
import { texts } from "./texts";
import { useFrameSignal } from "../../shared/hooks/use-frame-signal";
import { useGamepadInputs } from "./inputs/use-gamepad";
import { JointSlider } from "./joint-slider";
import { useHeldKeys, useKey } from "./inputs/keyboard-help";
import type { PanelProps } from "./panel-props";

/** Speed of the target while a key is held [rad/s], and its maximum lead over the joint [rad]. */
const RATE_RAD_S = radians(20);
const LEAD_RAD = radians(4);
const STEP_MS = 40;
/** Smaller differences are not visible [rad]. */
const SHOWN_RAD = 1e-5;

export function JointsPanel({ device, streamer, active, pad }: PanelProps) {
  const description = device.description.value;
  const joints = description?.joints ?? [];
  const [selected, setSelected] = useState(0);
  const rows = useRef<HTMLDivElement>(null);
  useJointJog({ device, streamer, active, pad }, selected);
  const telemetry = useFrameSignal(device.telemetry);

  const select = (index: number): void => {
    const next = clamp(index, 0, joints.length - 1);
    setSelected(next);
    rows.current?.children[next]?.scrollIntoView({ block: "nearest" });
  };
  useKey(active && joints.length > 0, (event) => {
    const index = jointOfKey(event.code);
    if (index !== null && index < joints.length) select(index);
    else if (event.key === "[") select(selected - 1);
    else if (event.key === "]") select(selected + 1);
    else return false;
    return true;
  });
  const cross = useRef(0);
  useSignalEffect(() => {
    const step = pad.reading.value?.cross[1] ?? 0;
    if (step !== 0 && cross.current === 0) select(selected - step);
    cross.current = step;
  });

  if (description === null) return <p class="quiet">{texts.joints.noDescription}</p>;
  return (
    <>
      <div class="joint-head" aria-hidden="true">
        <span>{texts.joints.heading.joint}</span>
        <span>{texts.joints.heading.target}</span>
        <span>{texts.joints.heading.measured}</span>
      </div>
      <div class="joint-rows" ref={rows}>
        {joints.map((joint, index) => (
          <LiveJoint
            key={joint.name}
            joint={joint}
            index={index}
            device={device}
            telemetry={telemetry}
            streamer={streamer}
            selected={active && streamer !== null && index === selected}
          />
        ))}
      </div>
      <p class="quiet small">{texts.joints.keys}</p>
    </>
  );
}

interface LiveJointProps extends Pick<PanelProps, "device" | "streamer"> {
  joint: Joint;
  index: number;
  telemetry: DeviceStore["telemetry"];
  selected: boolean;
}

/** Subscribes to telemetry here, so that the panel does not render at telemetry rate. */
function LiveJoint({ joint, index, device, telemetry, streamer, selected }: LiveJointProps) {
  const measured = useShown(telemetry, (message) => message.position_rad[index]);
  const commanded = useShown(telemetry, (message) => message.commanded_rad[index]);
  return (
    <JointSlider
      joint={joint}
      targetRad={streamer?.targets.value[joint.name] ?? commanded.value}
      measuredRad={measured.value}
      old={!device.live.value}
      selected={selected}
      onBegin={() => streamer?.begin()}
      onSet={streamer === null ? null : (positionRad) => streamer.setTarget(joint.name, positionRad)}
    />
  );
}

/** One position of the newest telemetry; changes only if the displayed value changes. */
function useShown(
  telemetry: DeviceStore["telemetry"],
  of: (message: KnownTelemetry) => number | undefined,
): ReadonlySignal<number | undefined> {
  return useComputed(() => {
    const at = telemetry.value === null ? undefined : of(telemetry.value.message);
    return at === undefined ? undefined : Math.round(at / SHOWN_RAD) * SHOWN_RAD;
  });
}

/** Moves the selected joint while a key or gamepad stick is held; the target leads by a small amount. */
function useJointJog({ device, streamer, active, pad }: PanelProps, selected: number): void {
  const rate = useRef(0);
  const newest = useRef(streamer);
  newest.current = streamer;
  const inputs = useMemo(
    () =>
      new PressedInputs<number>(
        (parts) => {
          rate.current = clamp(
            parts.reduce((sum, part) => sum + part, 0),
            -1,
            1,
          );
        },
        () => newest.current?.begin(),
      ),
    [],
  );
  // Without control, arrow keys scroll the page.
  useHeldKeys(active && streamer !== null, inputs, JOINT_KEYS);
  useGamepadInputs(pad, inputs, ({ left }) => left[1]);
  useEffect(
    () =>
      effect(() => {
        // As for a velocity, pressed inputs have no effect after the end of the stream.
        const ended = streamer?.ended.value ?? null;
        if (streamer === null || (ended !== null && ended !== "reached")) inputs.releaseAll();
      }),
    [inputs, streamer],
  );
  useEffect(() => {
    const releaseInputs = (): void => inputs.releaseAll();
    addEventListener("blur", releaseInputs);
    document.addEventListener("visibilitychange", releaseInputs);
    return () => {
      removeEventListener("blur", releaseInputs);
      document.removeEventListener("visibilitychange", releaseInputs);
      releaseInputs();
    };
  }, [inputs]);
  const joint = device.description.value?.joints[selected];
  useEffect(() => {
    if (streamer === null || joint === undefined) return;
    inputs.releaseAll();
    const timer = setInterval(() => {
      if (rate.current !== 0) step(streamer, joint, device.telemetry.peek()?.message.position_rad[selected]);
    }, STEP_MS);
    const step = (to: SetpointStreamer, one: Joint, measuredRad: number | undefined): void => {
      if (measuredRad === undefined) return;
      to.follow();
      const target = (to.targets.peek()[one.name] ?? measuredRad) + (rate.current * RATE_RAD_S * STEP_MS) / 1000;
      to.setTarget(one.name, clamp(target, measuredRad - LEAD_RAD, measuredRad + LEAD_RAD));
    };
    return () => {
      clearInterval(timer);
      inputs.releaseAll();
    };
  }, [streamer, joint, selected, device, inputs]);
}
