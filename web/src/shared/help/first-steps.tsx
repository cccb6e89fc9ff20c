/** Shown to an account without devices: create an agent, run it and pair it, also with a simulated robot. */
import { Card } from "../ui/card";
import { texts } from "./texts";
import { robotTypesAddress } from "../routing/routes";
import { AgentCommands } from "./agent-commands";
import { PageExplainer } from "./page-explainer";

/** Included in every installation. Simulated unless the configuration names a real robot. */
const EXAMPLE = { name: "arm", type: "ur5" };

export function FirstSteps() {
  const words = texts.firstSteps;
  return (
    <Card title={words.title} class="first-steps">
      <p>{words.explained}</p>
      <ol class="next-steps" data-testid="first-steps">
        <AgentCommands {...EXAMPLE} />
        <li>{words.pair}</li>
      </ol>
      <p>
        {words.simulated} <a href={robotTypesAddress}>{words.types}</a>
      </p>
      <p class="quiet">{words.shared}</p>
      <PageExplainer page="devices" />
    </Card>
  );
}
