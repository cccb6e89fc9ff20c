/** Converts script positions: the server counts characters, the editor UTF-16 units. */
import type { Mark } from "../../../shared/api/movement-library";

export interface TextRange {
  from: number;
  to: number;
  severity: Mark["severity"];
  message: string;
}

/** The offsets of a mark in a text: never outside of it, and not empty if possible. */
export function rangeOf(text: string, { severity, message, line, column, end_line, end_column }: Mark): TextRange {
  const lines = text.split(/\r\n?|\n/);
  const starts = [0];
  for (const each of lines) starts.push((starts.at(-1) ?? 0) + each.length + 1);
  const at = (row: number, characters: number): number => {
    const index = Math.min(Math.max(row, 1), lines.length) - 1;
    const units = Array.from(lines[index] ?? "").slice(0, characters).join("").length;
    return Math.min((starts[index] ?? 0) + units, text.length);
  };
  const from = at(line, column);
  return { from, to: Math.max(at(end_line, end_column), Math.min(from + 1, text.length)), severity, message };
}

/** The line of a failed run, which the sandbox puts first in the error; `null`: none. */
export function failureMark(why: string): Mark | null {
  const found = /\bline (\d+): (.+)/s.exec(why);
  if (found === null) return null;
  const line = Number(found[1]);
  return { severity: "error", message: found[2] ?? "", line, column: 0, end_line: line, end_column: 10_000 };
}
