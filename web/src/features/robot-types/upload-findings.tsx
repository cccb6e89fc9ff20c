/** Findings of an upload. */
import { Card } from "../../shared/ui/card";
import { degrees } from "../../shared/lib/angles";
import type { RobotType, TypeModel } from "../../shared/api/robot-types";
import { packFiles, type Files } from "./model/upload-files";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface UploadSummaryProps {
  type: RobotType;
  model: TypeModel | null;
  files: Files;
}

export function UploadSummary({ type, model, files }: UploadSummaryProps) {
  const words = texts.contents;
  const { wholeDegrees } = format;
  const movements = Object.keys(packFiles(files)?.movements ?? {});
  const lists: [string, string[]][] = [
    [
      words.joints,
      type.joints.map((joint) =>
        words.joint(
          joint.label,
          texts.range(wholeDegrees(degrees(joint.lower_rad)), wholeDegrees(degrees(joint.upper_rad))),
        ),
      ),
    ],
    [words.actuators, model?.actuators ?? []],
    [words.cameras, model?.cameras ?? []],
    [words.movements, movements],
    [words.abilities, type.capabilities.map((name) => name.replaceAll("_", " "))],
  ];
  return (
    <Card title={words.title}>
      <dl class="type-contents" data-testid="type-contents">
        {lists.map(([name, entries]) => (
          <div key={name}>
            <dt>{words.count(name, entries.length)}</dt>
            <dd>{entries.length === 0 ? words.none : entries.join(" · ")}</dd>
          </div>
        ))}
      </dl>
    </Card>
  );
}
