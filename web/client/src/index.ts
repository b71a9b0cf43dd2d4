export * from "./client.js";
export { Problem, type ProblemDocument, type ProblemName } from "./problem.js";
export type * from "./api.js";
