import { useState } from "preact/hooks";
import { degrees } from "../core/angles";
import type { DeviceStore } from "../core/device";
import { rollPitchYaw, unit } from "../core/kinematics";
import type { Pose } from "../core/vectors";
import { texts } from "../texts";
import { Card, Choice } from "./parts";

type Form = "degrees" | "quaternion";

/** Position and rotation of every joint's frame in the robot's base, as the paper's application shows them. */
export function PoseTable({ device }: { device: DeviceStore }) {
  const [form, setForm] = useState<Form>("degrees");
  const names = device.description.value?.frames ?? [];
  const poses = device.telemetry.value?.message.frames ?? [];
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
      {names.length === 0 ? (
        <p class="quiet">{texts.poses.none}</p>
      ) : (
        <div class="scroll" tabIndex={0} role="region" aria-label={texts.poses.table}>
          <table class={device.live.value ? "" : "old"} data-testid="poses">
            <thead>
              <tr>
                <th scope="col">{texts.poses.frame}</th>
                <th scope="col">{texts.poses.position}</th>
                <th scope="col">{form === "degrees" ? texts.poses.asDegrees : texts.poses.asQuaternion}</th>
              </tr>
            </thead>
            <tbody>
              {names.map((name, index) => (
                <PoseRow key={name} name={name} pose={poses[index]} form={form} />
              ))}
            </tbody>
          </table>
        </div>
      )}
    </Card>
  );
}

function PoseRow({ name, pose, form }: { name: string; pose: Pose | undefined; form: Form }) {
  const cells = pose === undefined ? [texts.number.unknown, texts.number.unknown] : poseText(pose, form);
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

/** Numbers side by side, each as wide as the others whatever its sign. */
function columns(values: readonly number[], digits: number): string {
  return values.map((value) => (Math.abs(value) < 0.5 / 10 ** digits ? 0 : value).toFixed(digits).padStart(digits + 5)).join(" ");
}
