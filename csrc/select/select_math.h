#pragma once

// Includes the formulas of selection. This comment proves that a cut is exact.
// docs/architecture.md has the bounds of rounding errors, and the test of each step.
// The formulas are compiled without floating-point contraction, so that the CPU and
// CUDA compute the same bits.
//
// A group g replaces finer clusters by coarser clusters, which it makes. g is called
// the parent group of the finer clusters, and the own group of the coarser clusters. A
// cluster c that is not a leaf has a group below it, own(c). A cluster c that is not a
// top cluster has a group above it, parent(c). On a path from a leaf to its root, the
// parent group of each cluster is the own group of the next cluster.
//
// refinement(g) is how far g is refined. It is 0 if g fits the tolerance, so that its
// coarser clusters suffice, and kWhole if they do not suffice. The cut gives each
// cluster c the weight
//   weight(c) = refinement(parent(c)) - refinement(own(c)).
// If there is no group below (a leaf), the second term is 0. If there is no group above
// (a top cluster), the first term is kWhole.
//
// 1. On each path from a leaf to its root, the weights add up to kWhole, because the
//    sum telescopes. Weights are integers, so there is no rounding.
// 2. No weight is negative if refinement never decreases towards the root. The balls of
//    groups nest, and the factors of their footprints never decrease towards the root,
//    so metrics do not decrease (footprint.h). refinement() is a monotonic function of
//    the metric (fade_math.h). It is limited by how far the group's page has faded in,
//    and is 0 if the page is absent. A page is resident and faded in at most as far as
//    the page above it, so this limit does not decrease either.
// 3. Without a fade, refinement is 0 or kWhole, because a group either fits or is
//    refined. By 1 and 2, exactly one cluster on each path is drawn.
// 4. Therefore clusters can be tested in any order and on any device. A decision
//    depends on two metrics and on the fades of two pages. The decisions about two
//    adjacent clusters of a path compare the same bits, because fits(), is_refined()
//    and refinement() contain all comparisons of a metric with the tolerance. The
//    comparisons in bounds_math.h only skip clusters that are not drawn, with a margin.
// 5. Culling removes clusters that cannot touch a pixel, and changes no weight.
//
// In the code, InstanceCut::drawn_weight() (cut_math.h) decides about a cluster. If the
// top clusters of an instance suffice (source_of_cut()), their weight is kWhole, and
// only is_culled() is tested. The CPU evaluates drawn_weight() in two passes: weight()
// for all clusters of an instance, then is_culled() for those with a positive weight
// (select_cpu.cpp). With Footprint::paper, statement 2 does not hold, because the
// footprint may decrease towards the root; a path may then have several drawn clusters.

#include "select/bounds_math.h"
#include "select/budget_math.h"
#include "select/cut_math.h"
#include "select/fade_math.h"
#include "select/footprint.h"
#include "select/frustum.h"
#include "select/instance_view.h"
#include "select/page_need.h"
#include "select/rule.h"
