import type { DeviceStore } from "../devices/model";
import { rollPitchYaw, unit } from "../twin/model";
import { Choice } from "../../shared/ui/choice";
import { useEffect, useState } from "preact/hooks";
import { degrees, radians } from "../../shared/lib/angles";
import type { Vector3 } from "../../shared/lib/vectors";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";
import { NumberField, numbersOf, FractionField } from "./action-form-fields";

type PathKind = "direct" | "straight" | "plan";

/** Moves a frame to a pose in the robot's base: metres, and rotations about x, y and z in degrees. */
export function MoveToPoseCard({ session, description, disabledReason }: ActionCardProps) {
  const { device } = session;
  const frames = description.frames;
  const [frame, setFrame] = useState(frames.at(-1) ?? "");
  const [fields, setFields] = useState<readonly string[]>(["", "", "", "", "", ""]);
  const [path, setPath] = useState<PathKind>("plan");
  const [speed, setSpeed] = useState(0.5);
  const fillCurrentPose = (): void => {
    const pose = measuredPose(device, frame);
    if (pose !== null) setFields(pose);
  };
  const hasTelemetry = device.telemetry.value !== null;
  // Start with the current pose, so that a small move does not require six numbers.
  useEffect(() => {
    if (fields.every((field) => field === "")) fillCurrentPose();
  }, [hasTelemetry]);
  const values = numbersOf(fields);
  const go = (event: SubmitEvent): void => {
    event.preventDefault();
    if (values === null || disabledReason !== "") return;
    startAction(session, {
      kind: "move_pose",
      position_m: values.slice(0, 3) as Vector3,
      rpy_rad: values.slice(3).map(radians) as Vector3,
      frame,
      speed,
      straight: path === "straight",
      plan: path === "plan",
    });
  };
  return (
    <form class="act-form" onSubmit={go}>
      <div class="row">
        <label>
          {texts.frame}{" "}
          <select value={frame} onChange={(event) => setFrame(event.currentTarget.value)}>
            {frames.map((name) => (
              <option key={name}>{name}</option>
            ))}
          </select>
        </label>
        <button type="button" data-testid="pose-here" disabled={!device.live.value} onClick={fillCurrentPose}>
          {texts.useCurrentPose}
        </button>
      </div>
      <div class="act-numbers">
        {[...texts.axes, ...texts.rotations].map((label, index) => (
          <NumberField
            key={label}
            label={label}
            unit={index < 3 ? "m" : "°"}
            value={fields[index] ?? ""}
            testid={`pose-${index}`}
            onInput={(value) => setFields(fields.with(index, value))}
          />
        ))}
      </div>
      <Choice label={texts.path} value={path} onChange={setPath} options={Object.entries(texts.paths) as [PathKind, string][]} />
      <FractionField label={texts.speed} value={speed} min={0.05} onChange={setSpeed} />
      <button
        type="submit"
        class="primary"
        data-testid="pose-go"
        disabled={values === null || disabledReason !== ""}
        title={disabledReason === "" ? undefined : disabledReason}
      >
        {texts.move}
      </button>
    </form>
  );
}

/** The frame's current pose as field values; `null` without live data. */
function measuredPose(device: DeviceStore, frame: string): readonly string[] | null {
  const index = device.description.value?.frames.indexOf(frame) ?? -1;
  const pose = device.telemetry.value?.message.frames[index];
  if (pose === undefined) return null;
  const [x, y, z, ...quaternion] = pose;
  const rotations = rollPitchYaw(unit(quaternion)).map((turn) => degrees(turn).toFixed(1));
  return [...[x, y, z].map((metres) => metres.toFixed(3)), ...rotations];
}
