#pragma once

namespace v3dg {

// Threads that a parallel region here asks OpenMP for, at least 1. It is what OpenMP was told, but
// no number that no machine has processors for, and 1 where threads would get stacks that do not
// fit: OpenMP would end the process.
int most_threads();

}  // namespace v3dg
