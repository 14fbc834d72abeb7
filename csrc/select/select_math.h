#pragma once

// The formulas of selection, and why a cut is exact, in short: docs/architecture.md has
// the bounds of rounding and the test of each step. Both halves compile them without
// contraction, so that they give the same bits.
//
// A group g replaces its finer clusters, whose parent group it is, by the coarser
// clusters that it made, whose own group it is. So each cluster c has a group below,
// own(c), except for leaves, and a group above, parent(c), except for the tops. Along a
// path from a leaf to its root, the parent group of each cluster is the own group of
// the next.
//
// refinement(g) says how far g is refined: from 0, where g fits the tolerance and its
// coarser clusters suffice, to kWhole, where they do not. The cut gives the cluster c
// the weight
//     weight(c) = refinement(parent(c)) - refinement(own(c)),
// where nothing is refined below a leaf (0) and everything is above a top (kWhole).
//
// 1. On every path from a leaf to its root the weights add up to kWhole: the sum
//    telescopes, and weights are integers, so nothing is rounded.
// 2. No weight is negative where refinement never decreases towards the root. The balls
//    of groups nest, and the factors of their footprints never decrease towards the
//    root, so metrics do not (footprint.h). refinement() is a monotonic function of the
//    metric (fade_math.h). It is lowered to how far the page of the group has faded in,
//    and to 0 where that page is not resident; pages are resident before those below
//    them, so neither limit decreases towards the root.
// 3. Without a fade refinement is 0 or kWhole, since fits() and is_refined() are then
//    each other's opposite. By 1 and 2 exactly one cluster on each path is drawn.
// 4. Hence it does not matter who asks, in which order, or on which device: each
//    decision depends on two metrics and on how far two pages have arrived, and two
//    neighbours on a path compare the same bits. Every comparison of a metric with the
//    tolerance is one of fits(), is_refined() and refinement(); those of bounds_math.h
//    only skip clusters that are not drawn, and leave a margin.
// 5. Culling drops clusters of the cut that cannot touch a pixel, and changes no
//    weight.
//
// InstanceCut::drawn_weight() (cut_math.h) is the decision about a cluster. Where the
// tops of an instance suffice (source_of_cut()) they have the weight kWhole, and only
// is_culled() is asked. The CUDA half calls both. The CPU half composes drawn_weight()
// in two passes: weight() for all clusters of an instance, then is_culled() for those
// whose weight is positive (select_cpu.cpp). With Footprint::paper 2 does not hold, as
// its metric may decrease towards the root: several clusters on a path may then be
// drawn.

#include "select/bounds_math.h"
#include "select/budget_math.h"
#include "select/cut_math.h"
#include "select/fade_math.h"
#include "select/footprint.h"
#include "select/frustum.h"
#include "select/instance_view.h"
#include "select/page_need.h"
#include "select/rule.h"
