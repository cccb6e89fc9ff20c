/** Action cards of a robot: one for each capability in its description. */
import { actionUnavailableReason } from "../devices";
import type { DeviceSession, Fleet } from "../devices/model";
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
import { BehavioursCard, ExpressionsCard, PosturesCard } from "./one-click-actions-card";
import { SpeechCard } from "./speech-card";
import { StiffnessCard } from "./stiffness-card";

export interface ActionCardProps {
  session: DeviceSession;
  description: KnownDescription;
  /** Why actions are unavailable now, or "". */
  no: string;
}

interface ActsProps {
  fleet: Fleet;
  session: DeviceSession;
}

export function ActionCards({ fleet, session }: ActsProps) {
  const description = session.device.description.value;
  if (description === null) return null;
  const no = actionUnavailableReason(session.device, session.control);
  const common: ActionCardProps = { session, description, no };
  const takes = (kind: AnyRequest["kind"]): boolean => description.actions.includes(kind);
  const cards: [string, string, boolean, ComponentChildren][] = [
    ["postures", texts.postures, takes("take_posture") && description.postures.length > 0, <PosturesCard {...common} />],
    ["expressions", texts.expressions, takes("express") && description.expressions.length > 0, <ExpressionsCard {...common} />],
    ["behaviours", texts.behaviours, takes("run_behaviour") && description.behaviours.length > 0, <BehavioursCard {...common} />],
    ["speech", texts.speech, takes("say"), <SpeechCard {...common} />],
    ["pose", texts.pose, takes("move_pose"), <MoveToPoseCard {...common} />],
    ["place", texts.place, takes("go_to"), <GoToPlaceCard {...common} fleet={fleet} />],
    ["look", texts.look, takes("look_at"), <LookAtCard {...common} />],
    ["stiffness", texts.stiffness, takes("set_stiffness"), <StiffnessCard {...common} />],
  ];
  return (
    <>
      {cards.map(
        ([name, title, there, card]) =>
          there && (
            <CollapsibleCard key={name} name={name} title={title} type={description.robot_type}>
              <Card title={title} class="act" aside={no === "" ? undefined : <span class="quiet small act-no">{no}</span>}>
                {card}
              </Card>
            </CollapsibleCard>
          ),
      )}
    </>
  );
}

/** Starts the action under this page's lease, or under one that the cloud takes for it. */
export function startAction({ actions, control }: DeviceSession, request: AnyRequest, back?: AnyRequest): void {
  void actions.start(request, control.epoch, back);
}
