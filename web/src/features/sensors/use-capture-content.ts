/** Loads the content of a captured file. */
import type { CapturedFile } from "./model/room-device-action";
import { texts } from "./texts";

/** Throws an `Error` with a displayable message: a store on another origin may reject this page. */
export async function contentOf({ url }: CapturedFile): Promise<Uint8Array<ArrayBuffer>> {
  try {
    const response = await fetch(url, { credentials: "omit" });
    if (!response.ok) throw new Error(String(response.status));
    return new Uint8Array(await response.arrayBuffer());
  } catch {
    throw new Error(texts.files.unreadable);
  }
}
