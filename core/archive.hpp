#pragma once
// What a run remembers between two steps, as bytes: it goes on from them as if it had never been interrupted.

#include <cassert>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <optional>
#include <span>
#include <stdexcept>
#include <type_traits>
#include <utility>
#include <vector>

#include "buffer.hpp"

namespace invariode {

using RunMemory = Buffer<std::byte>;

/// Bytes to which a memory is written, or from which it is read. Each class has one function `state(Archive&)` that
/// names its fields, so that what is written and what is read cannot disagree. Sizes are those of the problem: what
/// reads has been made for the same one, and a field of another size throws std::invalid_argument.
///
/// The bytes may be of a file that anyone wrote. What is read as a truth is one, and what is read as a count is not
/// negative and can be added to; a class whose fields are indices or sizes, or belong together, checks them by
/// `require` before it uses them. Numbers may have any value: they can spoil the solution, but nothing else.
class Archive {
 public:
  /// Raised whenever the fields of any class change, or their order.
  static constexpr std::uint32_t version = 16;

  /// Makes an archive to be written. Matrices of more than `most_values` entries are left out; a run that is read from
  /// it then restarts the method.
  explicit Archive(std::size_t most_values) : most_values_(most_values) {
    std::uint32_t own = version;
    written_.reserve(usual_size);
    (*this)(own, whole_);
  }
  /// Makes an archive that reads bytes that belong to the caller and outlive it.
  explicit Archive(std::span<const std::byte> bytes) : reading_(true), source_(bytes) {
    std::uint32_t written = 0;
    (*this)(written, whole_);
    if (written != version) throw std::invalid_argument("the memory of the run is of another version");
  }

  [[nodiscard]] bool reading() const { return reading_; }
  /// Returns whether the matrices are there.
  [[nodiscard]] bool whole() const { return whole_; }
  /// A user function has stopped the reading: see `Status::stop`.
  void stop() { stopped_ = true; }
  [[nodiscard]] bool stopped() const { return stopped_; }
  /// Throws while reading if a value that was read is not as it must be.
  void require(bool right) const {
    if (reading_ && !right) throw damaged();
  }
  /// All has been read.
  [[nodiscard]] bool exhausted() const { return place_ == source_.size(); }

  /// Returns the memory that was written, once.
  [[nodiscard]] RunMemory take() {
    assert(!reading_);
    const std::uint8_t whole = whole_ ? 1 : 0;
    std::memcpy(written_.data() + sizeof(version), &whole, sizeof(whole));
    return std::move(written_);
  }

  /// Fields one after the other: numbers, truths, counts, enumerations, what has a `state` of its own, optional ones,
  /// and vectors of numbers that keep their size. Whole numbers are counts; `values` takes others.
  template <class... Fields>
  void operator()(Fields&... fields) {
    (field(fields), ...);
  }
  /// `count` numbers.
  template <class T>
  void values(T* first, std::size_t count) {
    static_assert(std::is_trivially_copyable_v<T>);
    bytes(first, count * sizeof(T));
  }
  /// A vector that takes the size of what was written.
  template <class T>
  void resizable(std::vector<T>& v) {
    std::uint64_t size = v.size();
    field(size);
    if (reading_) {
      if (size > (source_.size() - place_) / sizeof(T)) throw damaged();
      v.resize(size);
    }
    values(v.data(), v.size());
  }
  /// The entries of a matrix. False: they are left out.
  bool matrix(std::vector<double>& entries) {
    bool kept = entries.size() <= most_values_;
    field(kept);
    whole_ = whole_ && kept;
    if (kept) resizable(entries);
    return kept;
  }

 private:
  static constexpr std::size_t usual_size = 1024;  // of small problems: room that need not grow field by field

  static std::invalid_argument damaged() {
    return std::invalid_argument("the memory of the run is damaged, or of another problem");
  }

  /// Runs add to their counts, and multiply them by a few.
  template <class T>
  static constexpr T most = std::numeric_limits<T>::max() / (sizeof(T) > sizeof(std::int32_t) ? 128 : 2);

  template <class T>
  void field(T& value) {
    if constexpr (requires(Archive& archive) { value.state(archive); }) {
      value.state(*this);
    } else {
      static_assert(std::is_arithmetic_v<T> || std::is_enum_v<T>);
      bytes(&value, sizeof(T));
      if constexpr (std::is_integral_v<T>) require(value >= 0 && value <= most<T>);
    }
  }
  void field(bool& value) {
    std::uint8_t byte = value ? 1 : 0;
    bytes(&byte, sizeof(byte));
    require(byte <= 1);
    value = byte == 1;
  }
  template <class T>
  void field(std::optional<T>& value) {
    bool there = value.has_value();
    T inside = value.value_or(T{});
    field(there);
    field(inside);
    if (reading_) value = there ? std::optional(inside) : std::nullopt;
  }
  template <class T>
  void field(std::vector<T>& v) {
    std::uint64_t size = v.size();
    field(size);
    if (size != v.size()) throw damaged();
    values(v.data(), v.size());
  }

  void bytes(void* data, std::size_t size) {
    if (size == 0) return;
    if (reading_) {
      if (size > source_.size() - place_) throw damaged();
      std::memcpy(data, source_.data() + place_, size);
      place_ += size;
    } else {
      written_.append(static_cast<const std::byte*>(data), size);
    }
  }

  bool reading_ = false;
  bool whole_ = true;
  bool stopped_ = false;
  std::size_t most_values_ = 0;
  RunMemory written_;
  std::span<const std::byte> source_;
  std::size_t place_ = 0;
};

/// An object that takes part in the memory of a run.
class Archived {
 public:
  virtual void state(Archive& archive) = 0;

 protected:
  Archived() = default;
  ~Archived() = default;
};

}  // namespace invariode
