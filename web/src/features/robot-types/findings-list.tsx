/** Errors and warnings of a robot type: location, description and advice. */
import { degrees } from "../../shared/lib/angles";
import type { Finding } from "./model/parse-findings";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";

interface FindingsProps {
  findings: readonly Finding[];
  level: "error" | "warning";
}

export function FindingsList({ findings, level }: FindingsProps) {
  if (findings.length === 0) return null;
  const words = texts.findings;
  return (
    <section class={`card findings ${level}`} data-testid={`${level}s`} aria-label={words.title[level](findings.length)}>
      <h2>{words.title[level](findings.length)}</h2>
      <ol>
        {findings.map((finding, index) => (
          <li key={index} data-testid={level} data-kind={finding.kind}>
            <p class="where">
              {finding.file === "" ? words.robotType : finding.file}
              {finding.line !== null && <span>, {words.line(finding.line)}</span>}
            </p>
            <p>{messageText(finding)}</p>
            {advice(finding) !== "" && <p class="quiet">{advice(finding)}</p>}
          </li>
        ))}
      </ol>
    </section>
  );
}

function messageText({ kind, message, subject, range_rad }: Finding): string {
  const words = texts.findings;
  if (kind === "missing") return words.missing(subject);
  if (kind === "malformed") return words.malformed;
  if (kind === "range" && range_rad !== null) {
    const [lower, upper] = range_rad.map((rad) => format.degrees(degrees(rad)));
    return (message.includes("actuator") ? words.motorRange : words.range)(subject, lower ?? "", upper ?? "");
  }
  return message;
}

function advice({ kind, file, subject }: Finding): string {
  return texts.findings.advice[kind](file, subject);
}
