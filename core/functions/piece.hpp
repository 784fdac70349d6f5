#pragma once
// The functions of a problem as a piece between two breakpoints sees them (docs/algorithms.md, 'Breakpoints').

#include <cassert>
#include <cmath>
#include <deque>
#include <limits>
#include <memory>
#include <utility>

#include "callback.hpp"
#include "linear/matrix.hpp"
#include "linear/preconditioner.hpp"
#include "series.hpp"
#include "weights.hpp"

namespace invariode {

/// The present piece of the interval. Functions that may jump at its ends are called through it, with times inside of
/// it only: at a breakpoint they get a double beside it, so that no stage sees the other side. What is made of
/// functions refers to this, and to nothing else.
class Piece {
 public:
  Piece() = default;
  Piece(const Piece&) = delete;
  Piece& operator=(const Piece&) = delete;

  /// Enters the piece between the times `from` and `to`. Functions are called at least so far from these, and one
  /// double in any case; at 0 an end bounds nothing.
  void enter(double from, double margin_from, double to, double margin_to) {
    assert(!std::isnan(from) && !std::isnan(to));
    constexpr double infinity = std::numeric_limits<double>::infinity();
    const double forward = to >= from ? infinity : -infinity;
    const double first = margin_from > 0 ? inside(from, margin_from, forward) : -forward;
    double last = margin_to > 0 ? inside(to, margin_to, -forward) : forward;
    if (forward * last < forward * first) last = first;  // there is no double between the two
    low_ = forward > 0 ? first : last;
    high_ = forward > 0 ? last : first;
  }

  Series within(const Series& series) {
    if (!series) return {};
    return {&Piece::series_entry, &series_.emplace_back(*this, series), series.order()};
  }
  Callback within(const Callback& function) {
    if (!function) return {};
    return {&Piece::callback_entry, &functions_.emplace_back(*this, function)};
  }
  MatrixFunction within(const MatrixFunction& function) {
    if (!function) return {};
    return {&Piece::matrix_entry, &matrices_.emplace_back(*this, function)};
  }
  Preconditioner within(const Preconditioner& preconditioner) {
    if (!preconditioner) return {};
    return {&Piece::set_up_entry, &Piece::solve_entry, &preconditioners_.emplace_back(*this, preconditioner)};
  }

  /// The first and the last time at which its functions see the time that they get.
  [[nodiscard]] double low() const { return low_; }
  [[nodiscard]] double high() const { return high_; }
  [[nodiscard]] double inside(double t) const { return t < low_ ? low_ : t > high_ ? high_ : t; }

 private:
  template <class Function>
  struct PieceFunction {
    PieceFunction(const Piece& piece_, Function function_) : piece(piece_), function(std::move(function_)) {}
    const Piece& piece;
    Function function;
  };

  /// The double that is `margin` beyond `end`, seen in the direction of `towards`.
  static double inside(double end, double margin, double towards) {
    return margin <= ulp(end) ? std::nextafter(end, towards) : end + std::copysign(margin, towards);
  }

  static Status callback_entry(void* self, double t, const double* y, double* out) {
    auto& [piece, function] = *static_cast<PieceFunction<Callback>*>(self);
    return function(piece.inside(t), y, out);
  }
  static Status series_entry(void* self, double t, double unit, const double* in, double* out) {
    auto& [piece, series] = *static_cast<PieceFunction<Series>*>(self);
    return series(piece.inside(t), unit, in, out);
  }
  static Status matrix_entry(void* self, double t, const double* y, Matrix& out) {
    auto& [piece, function] = *static_cast<PieceFunction<MatrixFunction>*>(self);
    return function(piece.inside(t), y, out);
  }
  static Status set_up_entry(void* self, double t, const double* y, double c, std::shared_ptr<void>& made) {
    auto& [piece, function] = *static_cast<PieceFunction<Preconditioner>*>(self);
    return function.set_up_(function.context_, piece.inside(t), y, c, made);
  }
  static Status solve_entry(void* self, void* made, double* b) {
    auto& [piece, function] = *static_cast<PieceFunction<Preconditioner>*>(self);
    return function.solve_(function.context_, made, b);
  }

  double low_ = -std::numeric_limits<double>::infinity(), high_ = std::numeric_limits<double>::infinity();
  std::deque<PieceFunction<Callback>> functions_;  // which stay where they are when there are more of them
  std::deque<PieceFunction<Series>> series_;
  std::deque<PieceFunction<MatrixFunction>> matrices_;
  std::deque<PieceFunction<Preconditioner>> preconditioners_;
};

}  // namespace invariode
