import type { RobotType } from "../../shared/api/robot-types";
import { texts } from "./texts";

/** Whether a type can be used, and the state of its newest upload. */
export function StatusChip({ type }: { type: RobotType }) {
  const newer = type.upload !== null && type.upload.version !== type.version ? type.upload : null;
  return (
    <span class="row">
      <span class={`chip type-${type.state}`} data-testid="type-state" data-state={type.state}>
        {texts.state[type.state]}
      </span>
      {newer !== null && (
        <span class={`chip type-${newer.state}`}>{texts.newer(newer.version, texts.state[newer.state])}</span>
      )}
    </span>
  );
}
