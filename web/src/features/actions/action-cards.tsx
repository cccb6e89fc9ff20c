/** Action cards of a robot: one for each capability in its description. */
import { actionUnavailableReason, recoveryUnavailableReason } from "../devices";
import type { DeviceSession } from "../control/model";
import type { Fleet } from "../devices/model";
import { Card } from "../../shared/ui/card";
import type { ComponentChildren } from "preact";
import type { KnownDescription } from "../../shared/mqtt/parse-messages";
import type { AnyRequest } from "../../shared/api/action-requests";
import { texts } from "./texts";
import { CollapsibleCard } from "../../shared/ui/collapsible-card";
import "./actions.css";
import { LookAtCard } from "./look-at-card";
import { GoToPlaceCard } from "./go-to-place-card";
import { MoveToPoseCard } from "./move-to-pose-card";
import { behaviourButtons } from "./model";
import { BehavioursCard, ExpressionsCard, PosturesCard, RecoveriesCard } from "./one-click-actions-card";
import { SpeechCard } from "./speech-card";
import { StiffnessCard } from "./stiffness-card";

export interface ActionCardProps {
  session: DeviceSession;
  description: KnownDescription;
  /** Why actions are unavailable now, or "". */
  disabledReason: string;
}

interface ActionCardsProps {
  fleet: Fleet;
  session: DeviceSession;
}

export function ActionCards({ fleet, session }: ActionCardsProps) {
  const description = session.device.description.value;
  if (description === null) return null;
  const disabledReason = actionUnavailableReason(session.device, session.control);
  const common: ActionCardProps = { session, description, disabledReason };
  const supports = (kind: AnyRequest["kind"]): boolean => description.actions.includes(kind);
  const { behaviours, recoveries } = behaviourButtons(description);
  const recovering = { ...common, disabledReason: recoveryUnavailableReason(session.device, session.control) };
  const cards: [string, string, boolean, ComponentChildren, string?][] = [
    ["recoveries", texts.recoveries, recoveries.length > 0, <RecoveriesCard {...recovering} />, recovering.disabledReason],
    ["postures", texts.postures, supports("take_posture") && description.postures.length > 0, <PosturesCard {...common} />],
    ["expressions", texts.expressions, supports("express") && description.expressions.length > 0, <ExpressionsCard {...common} />],
    ["behaviours", texts.behaviours, supports("run_behaviour") && behaviours.length > 0, <BehavioursCard {...common} />],
    ["speech", texts.speech, supports("say"), <SpeechCard {...common} />],
    ["pose", texts.pose, supports("move_pose"), <MoveToPoseCard {...common} />],
    ["place", texts.place, supports("go_to"), <GoToPlaceCard {...common} fleet={fleet} />],
    ["look", texts.look, supports("look_at"), <LookAtCard {...common} />],
    ["stiffness", texts.stiffness, supports("set_stiffness"), <StiffnessCard {...common} />],
  ];
  return (
    <>
      {cards.map(
        ([name, title, available, card, reason = disabledReason]) =>
          available && (
            <CollapsibleCard key={name} name={name} title={title} type={description.robot_type}>
              <Card title={title} class="act" aside={reason === "" ? undefined : <span class="quiet small act-no">{reason}</span>}>
                {card}
              </Card>
            </CollapsibleCard>
          ),
      )}
    </>
  );
}

/** Starts the action under this page's lease, or under one that the cloud takes for it. */
export function startAction({ actions, control }: DeviceSession, request: AnyRequest, undo?: AnyRequest): void {
  void actions.start(request, control.epoch, undo);
}
