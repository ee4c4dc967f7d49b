// SPDX-License-Identifier: Apache-2.0

// A Go server: goroutines, channels, timers, locks, the garbage collector; README.md says what it is asked.
package main

import (
	"bufio"
	"crypto/sha256"
	"fmt"
	"hash/crc32"
	"math/rand"
	"net"
	"os"
	"runtime"
	"strconv"
	"strings"
	"sync"
	"sync/atomic"
	"time"
)

const (
	money    = 1000
	accounts = 32
	patience = 20 * time.Second
)

var (
	mu          sync.Mutex
	counters    = map[string]int{}
	beats       = map[string]*int64{}
	wrong       []string
	connections int64
)

func beat(name string) *int64 {
	mu.Lock()
	defer mu.Unlock()
	n := new(int64)
	beats[name] = n
	return n
}

func complain(format string, args ...any) {
	mu.Lock()
	wrong = append(wrong, fmt.Sprintf(format, args...))
	mu.Unlock()
}

func data(n int, seed uint32) string {
	out := make([]byte, n)
	for i := range out {
		seed = (seed*1103515245 + 12345) & 0x7fffffff
		out[i] = "abcdefghijklmnop"[seed>>16&15]
	}
	return string(out)
}

var bank struct {
	sync.RWMutex
	account [accounts]int
}

func move(me int) {
	n := beat(fmt.Sprint("bank ", me))
	for {
		bank.Lock()
		amount := rand.Intn(19) - 9
		bank.account[rand.Intn(accounts)] -= amount
		if rand.Intn(10) == 0 {
			runtime.Gosched()
		}
		bank.account[rand.Intn(accounts)] += amount
		bank.Unlock()
		atomic.AddInt64(n, 1)
		time.Sleep(time.Duration(rand.Intn(5)) * time.Millisecond)
	}
}

// pipeline: numbers through three channels; none lost, none twice, in order.
func pipeline() {
	first, second, third := make(chan int), make(chan int, 8), make(chan int, 1)
	go func() {
		n := beat("pipeline 0")
		for i := 0; ; i++ {
			first <- i
			atomic.AddInt64(n, 1)
			if i%16 == 0 {
				time.Sleep(time.Millisecond)
			}
		}
	}()
	go func() {
		n := beat("pipeline 1")
		for i := range first {
			second <- i * 2
			atomic.AddInt64(n, 1)
		}
	}()
	go func() {
		n := beat("pipeline 2")
		for {
			select {
			case i := <-second:
				third <- i + 1
				atomic.AddInt64(n, 1)
			case <-time.After(50 * time.Millisecond):
			}
		}
	}()
	n := beat("pipeline 3")
	for i := 0; ; i++ {
		if got := <-third; got != 2*i+1 {
			complain("pipeline: %d instead of %d", got, 2*i+1)
			return
		}
		atomic.AddInt64(n, 1)
	}
}

var turns struct {
	sync.Mutex
	changed *sync.Cond
	turn    int
}

func takeTurns(me, of int) {
	n := beat(fmt.Sprint("condition ", me))
	for {
		turns.Lock()
		for turns.turn%of != me {
			turns.changed.Wait()
		}
		turns.turn++
		turns.changed.Broadcast()
		turns.Unlock()
		atomic.AddInt64(n, 1)
		time.Sleep(time.Millisecond)
	}
}

// hash has a thread of its own.
func hash(me int) {
	runtime.LockOSThread()
	n := beat(fmt.Sprint("hash ", me))
	block := []byte(data(50000, uint32(me)))
	right := sha256.Sum256(block)
	for {
		if sha256.Sum256(block) != right {
			complain("a hash is another one")
		}
		atomic.AddInt64(n, 1)
		time.Sleep(3 * time.Millisecond)
	}
}

func tick() {
	n := beat("ticker")
	for range time.NewTicker(5 * time.Millisecond).C {
		atomic.AddInt64(n, 1)
	}
}

// collect makes rubbish and has it collected, which signals every thread.
func collect() {
	n := beat("garbage")
	kept := make([]map[int]string, 0, 16)
	for {
		m := map[int]string{}
		for i := 0; i < 1000; i++ {
			m[i] = strconv.Itoa(i)
		}
		kept = append(kept, m)
		if len(kept) == cap(kept) {
			for i, text := range kept[0] {
				if text != strconv.Itoa(i) {
					complain("a map has changed: %d is %q", i, text)
				}
			}
			kept = append(kept[:0:0], kept[1:]...)
			kept = append(make([]map[int]string, 0, 16), kept...)
			runtime.GC()
		}
		atomic.AddInt64(n, 1)
		time.Sleep(10 * time.Millisecond)
	}
}

// pipes: a goroutine that waits in the poller for another, through the kernel.
func pipes() {
	r, w, err := os.Pipe()
	if err != nil {
		panic(err)
	}
	go func() {
		n := beat("pipe writer")
		for i := 0; ; i++ {
			fmt.Fprintln(w, i)
			atomic.AddInt64(n, 1)
			time.Sleep(2 * time.Millisecond)
		}
	}()
	n := beat("pipe reader")
	lines := bufio.NewScanner(r)
	for i := 0; lines.Scan(); i++ {
		if lines.Text() != strconv.Itoa(i) {
			complain("pipe: %q instead of %d", lines.Text(), i)
			return
		}
		atomic.AddInt64(n, 1)
	}
	complain("the pipe has ended")
}

func check() string {
	mu.Lock()
	before, now := map[string]int64{}, map[string]*int64{}
	for name, n := range beats {
		before[name], now[name] = atomic.LoadInt64(n), n
	}
	mu.Unlock()
	for deadline := time.Now().Add(patience); ; time.Sleep(5 * time.Millisecond) {
		var still []string
		for name, n := range before {
			if atomic.LoadInt64(now[name]) < n+2 {
				still = append(still, name)
			}
		}
		if len(still) == 0 {
			break
		}
		if time.Now().After(deadline) {
			return "bad these stand still: " + strings.Join(still, ", ")
		}
	}
	sum := 0
	bank.RLock()
	for _, each := range bank.account {
		sum += each
	}
	bank.RUnlock()
	if sum != money*accounts {
		return fmt.Sprintf("bad the accounts hold %d", sum)
	}
	mu.Lock()
	defer mu.Unlock()
	if len(wrong) > 0 {
		return "bad " + wrong[0]
	}
	return fmt.Sprintf("ok connections=%d goroutines=%d", atomic.LoadInt64(&connections), runtime.NumGoroutine())
}

func serve(c net.Conn) {
	atomic.AddInt64(&connections, 1)
	defer atomic.AddInt64(&connections, -1)
	defer c.Close()
	for in := bufio.NewReader(c); ; {
		line, err := in.ReadString('\n')
		if err != nil {
			return
		}
		words := strings.Fields(line)
		var answer string
		switch words[1] {
		case "inc":
			mu.Lock()
			counters[words[2]]++
			answer = strconv.Itoa(counters[words[2]])
			mu.Unlock()
		case "data":
			n, _ := strconv.Atoi(words[2])
			seed, _ := strconv.Atoi(words[3])
			text := data(n, uint32(seed))
			answer = fmt.Sprintf("%08x %s", crc32.ChecksumIEEE([]byte(text)), text)
		default:
			answer = check()
		}
		if _, err := fmt.Fprintf(c, "%s %s\n", words[0], answer); err != nil {
			return
		}
	}
}

func main() {
	for i := range bank.account {
		bank.account[i] = money
	}
	turns.changed = sync.NewCond(&turns)
	for i := 0; i < 4; i++ {
		go move(i)
	}
	for i := 0; i < 3; i++ {
		go takeTurns(i, 3)
	}
	for i := 0; i < 2; i++ {
		go hash(i)
	}
	go pipeline()
	go tick()
	go collect()
	go pipes()
	listener, err := net.Listen("tcp4", "0.0.0.0:7000")
	if err != nil {
		panic(err)
	}
	for {
		c, err := listener.Accept()
		if err != nil {
			panic(err)
		}
		go serve(c)
	}
}
