/** The behaviours of a device as buttons: the manifest's, those of the robot itself, and recoveries. */
import type { KnownDescription } from "../../../shared/mqtt/parse-messages";

export interface BehaviourButton {
  name: string;
  label: string;
}

interface BehaviourButtons {
  behaviours: BehaviourButton[];
  /** They remove a fault and move no joints, so they may also be started while Stop is latched. */
  recoveries: BehaviourButton[];
}

type Listed = Pick<KnownDescription, "behaviours" | "robot_behaviours">;

export function behaviourButtons(description: Listed): BehaviourButtons {
  const own = new Map(description.robot_behaviours.map((each) => [each.name, each]));
  const behaviours: BehaviourButton[] = [];
  const recoveries: BehaviourButton[] = [];
  for (const name of description.behaviours) {
    const each = own.get(name);
    (each?.recovery === true ? recoveries : behaviours).push({ name, label: each?.label ?? name });
  }
  return { behaviours, recoveries };
}

/** The robot's own name of a behaviour; any other name unchanged. */
export function behaviourLabel(description: Listed | null, name: string): string {
  return description?.robot_behaviours.find((each) => each.name === name)?.label ?? name;
}
