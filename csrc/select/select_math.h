#pragma once

// The formulas of selection, and a short proof that a cut is exact.
// docs/architecture.md has the bounds of rounding errors and the test of each step. The
// CPU and CUDA compile the formulas without contraction, so that both give the same
// bits.
//
// A group g replaces finer clusters by coarser clusters, which it makes. g is the
// parent group of the finer clusters and the own group of the coarser ones. So each
// cluster c has a group below, own(c), unless c is a leaf, and a group above,
// parent(c), unless c is a top cluster. Along a path from a leaf to its root, the
// parent group of each cluster is the own group of the next.
//
// refinement(g) says how far g is refined: from 0, if g fits the tolerance and its
// coarser clusters suffice, to kWhole, if they do not. The cut gives the cluster c the
// weight weight(c) = refinement(parent(c)) - refinement(own(c)), where nothing is
// refined below a leaf (0) and everything is refined above a top cluster (kWhole).
//
// 1. On every path from a leaf to its root the weights add up to kWhole: the sum
// telescopes, and weights are integers, so nothing is rounded. 2. No weight is negative
// where refinement never decreases towards the root. The balls of groups nest, and the
// factors of their footprints never decrease towards the root, so metrics do not
// decrease (footprint.h). refinement() is a monotonic function of the metric
// (fade_math.h). It is limited by how far the page of the group has faded in, and is 0
// if that page is not resident. Pages are resident before those below them, so neither
// limit decreases towards the root. 3. Without a fade refinement is 0 or kWhole, since
// fits() and is_refined() are then each other's opposite. By 1 and 2 exactly one
// cluster on each path is drawn. 4. Hence clusters may be tested in any order and on
// any device: each decision depends on two metrics and on how far two pages have faded
// in, and two neighbours on a path compare the same bits. Every comparison of a metric
// with the tolerance is in fits(), is_refined() or refinement(). The comparisons of
// bounds_math.h only skip clusters that are not drawn, and leave a margin. 5. Culling
// drops clusters of the cut that cannot touch a pixel, and changes no weight.
//
// InstanceCut::drawn_weight() (cut_math.h) is the decision about a cluster. If the top
// clusters of an instance suffice (source_of_cut()), they have the weight kWhole, and
// only is_culled() is tested. CUDA calls both. The CPU evaluates drawn_weight() in two
// passes: weight() for all clusters of an instance, then is_culled() for those whose
// weight is positive (select_cpu.cpp). With Footprint::paper, statement 2 does not
// hold, because its metric may decrease towards the root: then several clusters on a
// path may be drawn.

#include "select/bounds_math.h"
#include "select/budget_math.h"
#include "select/cut_math.h"
#include "select/fade_math.h"
#include "select/footprint.h"
#include "select/frustum.h"
#include "select/instance_view.h"
#include "select/page_need.h"
#include "select/rule.h"
