import { useState } from "preact/hooks";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";
import { NumberField, numbersOf } from "./action-form-fields";

/** Turns the gaze to a point in the robot's frame: x forward, y left, z up. */
export function LookAtCard({ session, disabledReason }: ActionCardProps) {
  const [point, setPoint] = useState(["1.0", "0.0", "0.5"]);
  const [x, y, z] = numbersOf(point) ?? [];
  const valid = x !== undefined && y !== undefined && z !== undefined;
  return (
    <form
      class="act-form"
      onSubmit={(event) => {
        event.preventDefault();
        if (valid && disabledReason === "") startAction(session, { kind: "look_at", position_m: [x, y, z] });
      }}
    >
      <div class="act-numbers">
        {texts.axes.map((axis, index) => (
          <NumberField
            key={axis}
            label={axis}
            unit="m"
            value={point[index] ?? ""}
            testid={`look-${index}`}
            onInput={(value) => setPoint(point.with(index, value))}
          />
        ))}
      </div>
      <p class="quiet small">{texts.lookNote}</p>
      <button type="submit" data-testid="look" disabled={!valid || disabledReason !== ""} title={disabledReason === "" ? undefined : disabledReason}>
        {texts.lookAt}
      </button>
    </form>
  );
}
