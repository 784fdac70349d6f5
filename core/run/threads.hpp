#pragma once
// Many independent tasks of unequal cost on several threads.

#include <algorithm>
#include <atomic>
#include <cassert>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <memory>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace invariode {

/// The indices that a worker has still to do. The owner takes from the front; a worker with nothing left takes the
/// back half. Both ends are in one word, so that each is one compare-and-swap.
class alignas(64) Share {
 public:
  void assign(std::uint32_t begin, std::uint32_t end) { ends_.store(pack(begin, end)); }

  /// The next index; false: none is left.
  bool take(std::uint32_t& index) {
    std::uint64_t ends = ends_.load();
    do {
      if (begin(ends) >= end(ends)) return false;
      index = begin(ends);
    } while (!ends_.compare_exchange_weak(ends, pack(index + 1, end(ends))));
    return true;
  }

  /// Moves the back half, at least one index, to `thief`, which must be empty; false: there is nothing.
  bool steal(Share& thief) {
    std::uint64_t ends = ends_.load();
    std::uint32_t middle;
    do {
      if (begin(ends) >= end(ends)) return false;
      middle = begin(ends) + (end(ends) - begin(ends)) / 2;
    } while (!ends_.compare_exchange_weak(ends, pack(begin(ends), middle)));
    thief.assign(middle, end(ends));
    return true;
  }

 private:
  static constexpr std::uint32_t half = 32;  // bits of each end
  static std::uint64_t pack(std::uint32_t begin, std::uint32_t end) { return std::uint64_t{begin} << half | end; }
  static std::uint32_t begin(std::uint64_t ends) { return static_cast<std::uint32_t>(ends >> half); }
  static std::uint32_t end(std::uint64_t ends) { return static_cast<std::uint32_t>(ends); }

  std::atomic<std::uint64_t> ends_ = 0;
};

/// Workers that share indices out among themselves, and how far they have come.
class WorkerPool {
 public:
  WorkerPool(std::uint32_t count, std::size_t workers) : shares_(workers), running_(workers) {
    for (std::size_t w = 0; w < workers; ++w)
      shares_[w].assign(static_cast<std::uint32_t>(std::uint64_t{count} * w / workers),
                        static_cast<std::uint32_t>(std::uint64_t{count} * (w + 1) / workers));
  }

  /// The next index of worker number `own`: of its share, then of parts of the others'. False: there are no more, or
  /// the rest is cancelled.
  bool next(std::size_t own, std::uint32_t& index) {
    assert(own < shares_.size());
    do {
      if (cancelled()) return false;
      if (shares_[own].take(index)) return true;
    } while (steal(own));
    return false;
  }
  /// One more has been done.
  void finish_one() { done_.fetch_add(1, std::memory_order_relaxed); }
  /// The first of these to throw cancels the rest; `rethrow` throws it again.
  template <class Act>
  void guarded(Act act) noexcept {
    try {
      act();
    } catch (...) {
      const std::scoped_lock lock(mutex_);
      if (!error_) error_ = std::current_exception();
      cancelled_ = true;
    }
  }
  void rethrow() {
    if (error_) std::rethrow_exception(error_);
  }

  void cancel() { cancelled_ = true; }
  [[nodiscard]] bool cancelled() const { return cancelled_.load(std::memory_order_relaxed); }
  [[nodiscard]] const std::atomic<bool>& cancellation() const { return cancelled_; }
  [[nodiscard]] std::uint32_t done() const { return done_.load(); }
  /// This many workers have ended, or never began.
  void end_workers(std::size_t workers) {
    const std::scoped_lock lock(mutex_);
    assert(workers <= running_);
    running_ -= workers;
    ended_.notify_one();
  }
  /// Waits as long as that. True: all have ended.
  bool wait(std::chrono::milliseconds interval) {
    std::unique_lock lock(mutex_);
    return ended_.wait_for(lock, interval, [&] { return running_ == 0; });
  }

 private:
  bool steal(std::size_t own) {
    for (std::size_t k = 1; k < shares_.size(); ++k)
      if (shares_[(own + k) % shares_.size()].steal(shares_[own])) return true;
    return false;
  }

  std::vector<Share> shares_;
  std::atomic<bool> cancelled_ = false;
  std::atomic<std::uint32_t> done_ = 0;
  std::mutex mutex_;  // of the last three
  std::condition_variable ended_;
  std::size_t running_;
  std::exception_ptr error_;
};

/// The indices that one worker is to do, one after the other or several together.
class Queue {
 public:
  Queue(WorkerPool& pool, std::size_t own) : pool_(pool), own_(own) {}

  /// The next one; false: there are no more, or the rest is cancelled.
  bool next(std::uint32_t& index) { return pool_.next(own_, index); }
  /// One of those taken has been done.
  void finish_one() { pool_.finish_one(); }
  /// The flag that work that takes long has to look at.
  [[nodiscard]] const std::atomic<bool>& cancelled() const { return pool_.cancellation(); }

 private:
  WorkerPool& pool_;
  std::size_t own_;
};

/// Calls work(worker, queue) on each of `workers` threads, whose queues share out all indices < count; meanwhile, every
/// `interval` and at the end, watch(done) on the calling thread, which cancels what is left by returning false. True:
/// all were done. What work or watch throws first cancels the rest, and is thrown again when all threads have ended.
template <class Work, class Watch>
bool on_workers(std::uint32_t count, std::size_t workers, std::chrono::milliseconds interval, Work work, Watch watch) {
  WorkerPool pool(count, workers);
  const auto worker = [&](std::size_t w) {
    Queue queue(pool, w);
    pool.guarded([&] { work(w, queue); });
    pool.end_workers(1);
  };
  std::vector<std::thread> threads;
  threads.reserve(workers);
  try {
    for (std::size_t w = 0; w < workers; ++w) threads.emplace_back(worker, w);
  } catch (...) {  // the system gives no more threads: those that run take the others' shares
    if (threads.empty()) throw;
    pool.end_workers(workers - threads.size());
  }
  const auto look = [&] {
    if (!watch(pool.done())) pool.cancel();
  };
  while (!pool.wait(interval)) pool.guarded(look);
  for (std::thread& thread : threads) thread.join();
  pool.rethrow();
  look();
  return !pool.cancelled();
}

}  // namespace invariode
