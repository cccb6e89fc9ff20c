import type { DeviceStore } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { Choice } from "../../shared/ui/choice";
import { useState } from "preact/hooks";
import { degrees } from "../../shared/lib/angles";
import { jointFrames, rollPitchYaw, unit } from "./model/forward-kinematics";
import type { Pose } from "../../shared/lib/vectors";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

type Form = "degrees" | "quaternion";
type FrameSource = "published" | "joints";

interface Frame {
  name: string;
  pose: Pose | undefined;
}

/** Position and rotation of every joint's frame in the robot's base, as in the paper's application. */
export function JointPoseTable({ device }: { device: DeviceStore }) {
  const [form, setForm] = useState<Form>("degrees");
  const [source, setSource] = useState<FrameSource>("published");
  const frames = source === "published" ? publishedFrames(device) : computedFrames(device);
  return (
    <Card
      title={texts.poses.title}
      class="poses"
      aside={
        <Choice
          label={texts.poses.showAs}
          value={form}
          onChange={setForm}
          options={[
            ["degrees", texts.poses.asDegrees],
            ["quaternion", texts.poses.asQuaternion],
          ]}
        />
      }
    >
      {device.twin.value !== null && (
        <Choice
          label={texts.poses.source}
          value={source}
          onChange={setSource}
          options={[
            ["published", texts.poses.publishedFrames],
            ["joints", texts.poses.joints],
          ]}
        />
      )}
      {frames.length === 0 ? (
        <p class="quiet">{texts.poses.none}</p>
      ) : (
        <div class="scroll poses-scroll" tabIndex={0} role="region" aria-label={texts.poses.table}>
          <table class={device.live.value ? "" : "old"} data-testid="poses">
            <thead>
              <tr>
                <th scope="col">{texts.poses.frame}</th>
                <th scope="col">{texts.poses.position}</th>
                <th scope="col">{form === "degrees" ? texts.poses.asDegrees : texts.poses.asQuaternion}</th>
              </tr>
            </thead>
            <tbody>
              {frames.map(({ name, pose }) => (
                <PoseRow key={name} name={name} pose={pose} form={form} />
              ))}
            </tbody>
          </table>
        </div>
      )}
      {source === "joints" && <p class="quiet small">{texts.poses.computedFrames}</p>}
      {!device.live.value && frames.some(({ pose }) => pose !== undefined) && <p class="quiet small">{texts.poses.old}</p>}
    </Card>
  );
}

/** Frames that the robot measures. */
function publishedFrames(device: DeviceStore): Frame[] {
  const poses = device.telemetry.value?.message.frames ?? [];
  return (device.description.value?.frames ?? []).map((name, index) => ({ name, pose: poses[index] }));
}

/** Joint frames computed from the twin and the measured positions. */
function computedFrames(device: DeviceStore): Frame[] {
  const [twin, description] = [device.twin.value, device.description.value];
  const message = device.telemetry.value?.message;
  if (twin === null || description === null || message === undefined) return [];
  const positions: Record<string, number> = {};
  description.joints.forEach((joint, index) => (positions[joint.name] = message.position_rad[index] ?? 0));
  const labels = new Map(description.joints.map(({ name, label }) => [name, label]));
  return jointFrames(twin, positions).map(({ name, position_m: at, quaternion }) => ({
    name: labels.get(name) ?? name,
    pose: [...at, ...quaternion],
  }));
}

function PoseRow({ name, pose, form }: { name: string; pose: Pose | undefined; form: Form }) {
  const cells = pose === undefined ? [format.unknown, format.unknown] : poseText(pose, form);
  return (
    <tr>
      <th scope="row">{name}</th>
      {cells.map((text, index) => (
        <td key={index}>{text}</td>
      ))}
    </tr>
  );
}

function poseText([x, y, z, qw, qx, qy, qz]: Pose, form: Form): [string, string] {
  const position = columns([x, y, z], 3);
  if (form === "quaternion") return [position, columns([qw, qx, qy, qz], 3)];
  return [position, columns(rollPitchYaw(unit([qw, qx, qy, qz])).map(degrees), 1)];
}

/** Numbers side by side, each with the same width regardless of sign. */
function columns(values: readonly number[], digits: number): string {
  return values.map((value) => (Math.abs(value) < 0.5 / 10 ** digits ? 0 : value).toFixed(digits).padStart(digits + 5)).join(" ");
}
