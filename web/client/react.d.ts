/** Types of `<molmesh-viewer>` for React 19, which has a JSX namespace of its own. */

import type { MolmeshViewerProps } from "./dist/viewer.js";

declare module "react" {
  namespace JSX {
    interface IntrinsicElements {
      "molmesh-viewer": MolmeshViewerProps;
    }
  }
}
