/** A web worker that downloads and decodes segments, so that the page stays responsive. */
import { ApiError, sentence } from "../../../../shared/api/http";
import { storedFile, storedPart } from "../../../../shared/api/recordings";
import { decodeExcerpt, decodeSegment } from "./decode-segment";
import { RemoteFile } from "./remote-file";
import { buffersOf } from "./segment";
import type { WorkerCall, WorkerResult } from "./segment-loader";

const running = new Map<number, AbortController>();

addEventListener("message", ({ data: call }: MessageEvent<WorkerCall>) => {
  if (call.url === null) running.get(call.id)?.abort();
  else void load(call.id, call.url, call.length, call.at_s);
});

async function load(id: number, url: string, length: number, at_s: number | null): Promise<void> {
  const controller = new AbortController();
  running.set(id, controller);
  try {
    // An abort may arrive while decoding.
    const pause = async (): Promise<void> => {
      await new Promise((resolve) => setTimeout(resolve));
      controller.signal.throwIfAborted();
    };
    const file = new RemoteFile(length, (from, to) => storedPart(url, from, to, controller.signal));
    const excerpt = at_s === null ? null : await decodeExcerpt(file, at_s, pause);
    if (excerpt !== null) answer({ id, excerpt }, buffersOf(excerpt));
    const segment = await decodeSegment(file.content ?? (await storedFile(url, controller.signal)), pause);
    answer({ id, segment }, buffersOf(segment));
  } catch (error) {
    if (!controller.signal.aborted) answer({ id, status: error instanceof ApiError ? error.status : null, error: sentence(error) });
  } finally {
    running.delete(id);
  }
}

function answer(result: WorkerResult, buffers: ArrayBuffer[] = []): void {
  postMessage(result, { transfer: buffers });
}
