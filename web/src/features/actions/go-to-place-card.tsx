/** Drives to a place in the room, selected on the floor plan or typed. */
import type { Fleet } from "../devices/model";
import { Drawing, useFloorPlan } from "../spaces";
import { useEffect, useMemo, useState } from "preact/hooks";
import { degrees, radians } from "../../shared/lib/angles";
import type { GoTo } from "../../shared/mqtt/protocol.generated";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";
import { NumberField, numberOf } from "./action-form-fields";

const STEP_M = 0.1;

export function GoToPlaceCard({ session, disabledReason, fleet }: ActionCardProps & { fleet: Fleet }) {
  const { device } = session;
  const { space, agent, name } = device.info.value;
  const plan = useFloorPlan(fleet, space, agent);
  const [x, setX] = useState("");
  const [y, setY] = useState("");
  const [heading, setHeading] = useState("");
  const ids = plan.devices.map(({ id }) => id).join();
  useEffect(() => {
    const ends = plan.devices.filter(({ id }) => id !== device.id).map((one) => one.watchMeasurements());
    return () => ends.forEach((end) => end());
  }, [ids]);

  const current = plan.places.find((place) => place.name === name) ?? null;
  const [xM, yM, deg] = [numberOf(x), numberOf(y), numberOf(heading)];
  const target = useMemo(
    () => (xM === null || yM === null ? null : { xM, yM, yawRad: deg === null ? null : radians(deg) }),
    [xM, yM, deg],
  );
  const pick = (pickedX: number, pickedY: number): void => {
    setX(pickedX.toFixed(2));
    setY(pickedY.toFixed(2));
  };
  const invalidHeading = heading.trim() !== "" && deg === null;
  const go = (event: SubmitEvent): void => {
    event.preventDefault();
    if (target === null || disabledReason !== "" || invalidHeading) return;
    const goal: GoTo = { kind: "go_to", x_m: target.xM, y_m: target.yM, yaw_rad: target.yawRad };
    if (current === null) startAction(session, goal);
    else startAction(session, goal, { kind: "go_to", x_m: current.xM, y_m: current.yM, yaw_rad: current.yawRad });
  };
  return (
    <form class="act-form" onSubmit={go}>
      {plan.extent === null ? (
        <p class="quiet">{plan.perception === null ? texts.planMissing : texts.planWaiting}</p>
      ) : (
        <Drawing {...plan} extent={plan.extent} mounted={[]} trails={null} target={target} onPick={pick} />
      )}
      <p class="quiet small">{texts.placeNote}</p>
      <div class="act-numbers">
        <NumberField label={texts.axes[0]} unit="m" value={x} testid="place-x" onInput={setX} />
        <NumberField label={texts.axes[1]} unit="m" value={y} testid="place-y" onInput={setY} />
        <NumberField label={texts.heading} unit="°" optional value={heading} testid="place-heading" onInput={setHeading} />
      </div>
      <div class="row">
        <button
          type="submit"
          class="primary"
          data-testid="place-go"
          disabled={target === null || invalidHeading || disabledReason !== ""}
          title={disabledReason === "" ? undefined : disabledReason}
        >
          {texts.go}
        </button>
        <button
          type="button"
          disabled={current === null}
          onClick={() => {
            if (current === null) return;
            pick(Math.round(current.xM / STEP_M) * STEP_M, Math.round(current.yM / STEP_M) * STEP_M);
            setHeading(current.yawRad === null ? "" : degrees(current.yawRad).toFixed(0));
          }}
        >
          {texts.useCurrentPosition}
        </button>
      </div>
    </form>
  );
}
